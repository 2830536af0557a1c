"""From a video or photographs of a printed board to a camera file; and the board to print."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from fieldpose.deploy.calibrating import Calibrated, calibrate
from fieldpose.deploy.reporting.output import check_writable, progress_bar, write_bytes, write_json
from fieldpose.deploy.reporting.sheets import Sheet, check_sheet, encoded
from fieldpose.deploy.shots import FILMED_S
from fieldpose.errors import GeometryError, UsageError
from fieldpose.stages.camera.boards import MARKER, Board
from fieldpose.stages.camera.lenses import FEWEST_VIEWS


@dataclass(frozen=True)
class Options:
    """Find a camera's focal length and distortion by a printed board, and write them as a camera file for `run`.

    Example: fieldpose calibrate board.mp4 --out camera.json

    Print a board first (fieldpose calibrate --print-board board.pdf), or show it on a flat screen. Film it for half a
    minute, slowly: near enough to fill a third of the picture, tilted by 30 to 45 degrees to each side, and in all
    parts of the picture, its corners too. Zoom, focus and stabilisation stay as they will be in use. Views that differ
    are chosen, and as many coefficients of distortion as views that were left out speak for. Images are turned as the
    video or their EXIF says. The camera file is for images of any size with this shape. The JSON file has: camera,
    focal_sd_px (standard deviation of the focal length), error_px, terms (of the distortion), views (that count), shown
    (that differ), seen (images), covered (share of the image that the board has been in), tilt_deg, notes, seconds.
    """

    source: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="SOURCE", help_behavior_hint="")] = None
    """A video file, a folder of photographs, or a source as `run` takes it (video:FILE, mcap:FILE, bag:FILE of ROS,
    camera:0)."""
    out: Path | None = None
    """The camera file to write (.json)."""
    print_board: Path | None = None
    """Write the board into this file (.png or .pdf) to be printed at 100 %; no source is read."""
    board: Literal["charuco", "chess"] = "charuco"
    """charuco: a chessboard with a marker in each white square, of which parts may be hidden or out of the picture;
    chess: a plain one, which is found where the whole of it is seen."""
    squares: str = "7x5"
    """How many squares across and down, for both kinds: a chessboard with 9x6 inner corners has 10x7 squares."""
    square: float = 0.03
    """Length of a square's side in metres; it is for the print, since a camera file has no lengths."""
    marker: float = MARKER
    """Side of a ChArUco board's markers: in metres where it is shorter than a square, else as a share of a square's."""
    family: Literal["4x4", "5x5", "6x6", "7x7", "aruco", "tag16h5", "tag25h9", "tag36h11"] = "4x4"
    """Of the markers: ArUco's dictionaries by their bits, ArUco's original one, or AprilTag's families."""
    most: int = 60
    """At most so many views count."""
    size: int | None = None
    """Images whose longer side has more pixels are shrunk to it; by default none are."""
    seconds: float = FILMED_S
    """How long a live camera films; Ctrl-C ends it as well, and what was filmed is used."""
    paper: Literal["a4", "letter"] = "a4"
    """Of --print-board."""
    dpi: int = 300
    """Dots an inch of --print-board, about: a square has whole dots."""
    json: Path | None = None
    """Write the figures into this file."""

    def run(self) -> int:
        """Calibrate, or draw the board, and say what was done."""
        board = self._board()
        if self.print_board is not None:
            self._print(board, self.print_board)
            return 0
        if self.source is None or self.out is None:
            raise UsageError("give a SOURCE and --out FILE to calibrate, or --print-board FILE to have a board to film")
        if self.most < FEWEST_VIEWS or (self.size is not None and self.size < 64):
            raise UsageError(f"--most must be at least {FEWEST_VIEWS}, and --size at least 64")
        if not 0 < self.seconds < float("inf"):
            raise UsageError(f"--seconds {self.seconds}: expected more than 0")
        check_writable(self.out, self.json)
        began = time.monotonic()
        with progress_bar("calibrate") as report:
            found = calibrate(self.source, board, self.most, self.size, self.seconds, report)
        seconds = time.monotonic() - began
        write_json(self.out, found.camera)
        write_json(self.json, {**asdict(found), "seconds": seconds})
        for line in _in_words(found, self.out, seconds):
            print(line)
        return 0

    def _board(self) -> Board:
        counts = re.fullmatch(r"(\d{1,3})x(\d{1,3})", self.squares)
        if counts is None:
            raise UsageError(f"--squares {self.squares}: expected squares across and down, as 7x5")
        if not 0 < self.square < float("inf"):
            raise UsageError(f"--square {self.square}: expected the length of a side in metres")
        share = self.marker / self.square if 0 < self.marker < self.square else self.marker
        try:
            return Board(self.board, int(counts[1]), int(counts[2]), share, self.family)
        except GeometryError as error:
            raise UsageError(f"--squares, --marker or --family: {error}") from error

    def _print(self, board: Board, path: Path) -> None:
        if self.source is not None or self.out is not None:
            raise UsageError("--print-board writes a board to film and reads no source; leave out SOURCE and --out")
        if not 72 <= self.dpi <= 1200:
            raise UsageError(f"--dpi {self.dpi}: expected 72 to 1200")
        check_sheet(path)
        check_writable(path)
        sheet = Sheet(board, self.square, self.paper, self.dpi)
        write_bytes(path, encoded(sheet, path.suffix))
        side = self.square * 1000
        size = f"{board.across * side:g} x {board.down * side:g} mm"
        print(f"{path}: {board.named} squares of {side:g} mm, {size} on {self.paper} paper")
        print("print it at 100 %, not fitted to the page, and put it on something flat")
        print(f"next: fieldpose calibrate VIDEO --out camera.json {sheet.options()}")


def _in_words(found: Calibrated, out: Path, seconds: float) -> Iterator[str]:
    camera = found.camera
    yield (
        f"{out}: focal length {camera.fx:.1f} +- {found.focal_sd_px:.1f} px at {camera.width}x{camera.height},"
        f" distortion: {found.terms}; error {found.error_px:.2f} px; {seconds:.0f} s"
    )
    yield (
        f"by {found.views} views of {found.shown} that differ (of {found.seen} images), tilted by up to"
        f" {found.tilt_deg:.0f} degrees, in {found.covered:.0%} of the image"
    )
    yield from found.notes
    yield f"next: fieldpose run FIELD --source SOURCE --camera.camera-file {out}"
