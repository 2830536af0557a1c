"""A calibration board on a sheet of paper, in its true size, with what it is and a bar to hold a ruler to."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from fieldpose.errors import GeometryError, OutputError, UsageError
from fieldpose.stages.camera.boards import Board, drawn

KINDS = (".png", ".pdf")
"""What a sheet may be written as."""
Paper = Literal["a4", "letter"]
_PAPERS: Mapping[Paper, tuple[float, float]] = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
_INCH_MM = 25.4
_MARGIN_MM, _FOOT_MM = 10.0, 22.0
"""Around everything, which printers leave white, and for the text below the board."""
_BAR_MM, _TICK_MM = 100, 10
_TEXT_MM, _LINE_MM = 3.2, 0.25
_FEWEST_DOTS = 8


@dataclass(frozen=True)
class Sheet:
    """A board on paper: its squares' side in metres. dots: wanted for an inch."""

    board: Board
    square_m: float
    paper: Paper = "a4"
    dots: int = 300

    def draw(self) -> tuple[Image.Image, float]:
        """The page in black and white, and how many dots an inch of it has, so that a square is whole dots.

        Raises UsageError for a board that is larger than the paper.
        """
        side = round(self.square_m * 1000 / _INCH_MM * self.dots)
        if side < _FEWEST_DOTS:
            raise UsageError(
                f"squares of {self.square_m * 1000:g} mm have {side} dots; give a larger --square or --dpi"
            )
        dots_mm = side / (self.square_m * 1000)
        width_mm, height_mm = self._page()
        page = np.full((round(height_mm * dots_mm), round(width_mm * dots_mm)), 255, np.uint8)
        try:
            board = drawn(self.board, side)
        except GeometryError as error:
            raise UsageError(f"--square or --dpi: {error}") from error
        left = (page.shape[1] - board.shape[1]) // 2
        top = max(round(_MARGIN_MM * dots_mm), (page.shape[0] - round(_FOOT_MM * dots_mm) - board.shape[0]) // 2)
        page[top : top + board.shape[0], left : left + board.shape[1]] = board
        image = Image.fromarray(page)
        self._write_foot(ImageDraw.Draw(image), dots_mm, width_mm, height_mm)
        return image.convert("1", dither=Image.Dither.NONE), dots_mm * _INCH_MM

    def options(self) -> str:
        """The options of `fieldpose calibrate` for this board."""
        board = self.board
        shared = f"--board {board.kind} --squares {board.named} --square {self.square_m:g}"
        return shared if board.kind == "chess" else f"{shared} --marker {board.marker:g} --family {board.family}"

    def _page(self) -> tuple[float, float]:
        """Width and height in mm, whichever way up the board has more room."""
        across, down = self.board.across * self.square_m * 1000, self.board.down * self.square_m * 1000
        short, long = _PAPERS[self.paper]
        fitting = []
        for width, height in ((short, long), (long, short)):
            room = (width - 2 * _MARGIN_MM, height - 2 * _MARGIN_MM - _FOOT_MM)
            fitting.append((min(room[0] / across, room[1] / down), width, height))
        scale, width, height = max(fitting)
        if scale < 1:
            largest = np.floor(scale * self.square_m * 1000 * 2) / 2000
            size = f"{self.board.named} squares of {self.square_m * 1000:g} mm is {across:g} x {down:g} mm"
            raise UsageError(
                f"a board of {size}, more than paper of {self.paper} has room for; give --square {largest:g} at most,"
                " or fewer --squares"
            )
        return width, height

    def _write_foot(self, draw: ImageDraw.ImageDraw, dots_mm: float, width_mm: float, height_mm: float) -> None:
        left, foot = _MARGIN_MM, height_mm - _MARGIN_MM - _FOOT_MM + 6
        font, line = _font(round(_TEXT_MM * dots_mm)), max(1, round(_LINE_MM * dots_mm))

        def at(x: float, y: float) -> tuple[int, int]:
            return round(x * dots_mm), round(y * dots_mm)

        bar_left, bar = (width_mm - _BAR_MM) / 2, foot + 3
        draw.line([at(bar_left, bar), at(bar_left + _BAR_MM, bar)], fill=0, width=line)
        for mm in range(0, _BAR_MM + 1, _TICK_MM):
            tall = 3.0 if mm % 50 == 0 else 1.8
            draw.line([at(bar_left + mm, bar - tall), at(bar_left + mm, bar)], fill=0, width=line)
        draw.text(at(bar_left + _BAR_MM + 2, bar), f"{_BAR_MM} mm", fill=0, font=font, anchor="ls")
        draw.text(at(bar_left - 2, bar), "0", fill=0, font=font, anchor="rs")
        lines = (
            f"{self.board.named} squares of {self.square_m * 1000:g} mm: print at 100 %, not fitted to the page, hold a"
            " ruler to the bar, and keep the sheet flat",
            f"fieldpose calibrate VIDEO --out camera.json {self.options()}",
        )
        for i, text in enumerate(lines):
            room = round((width_mm - 2 * left) * dots_mm)
            fitting = next(f for f in map(_font, range(round(_TEXT_MM * dots_mm), 0, -1)) if f.getlength(text) <= room)
            draw.text(at(width_mm / 2, bar + 6 + i * 1.6 * _TEXT_MM), text, fill=0, font=fitting, anchor="ms")


def check_sheet(path: Path) -> None:
    """Raise OutputError for a name that is none of a sheet."""
    if path.suffix.lower() not in KINDS:
        raise OutputError(f"{path}: no name of a sheet to print; end it in {KINDS[0]} or {KINDS[1]}")


def encoded(sheet: Sheet, suffix: str) -> bytes:
    """The bytes of a file of that kind, which says how large it is. Raises UsageError as Sheet.draw does."""
    image, dots = sheet.draw()
    content = io.BytesIO()
    if suffix.lower() == ".pdf":
        image.save(content, "PDF", resolution=dots, title=f"{sheet.board.named} squares of {sheet.square_m:g} m")
    else:
        image.save(content, "PNG", dpi=(dots, dots), optimize=True)
    return content.getvalue()


def _font(pixels: int) -> Any:
    from matplotlib import get_data_path

    return ImageFont.truetype(Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", max(pixels, 1))
