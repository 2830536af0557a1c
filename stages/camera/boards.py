"""Flat boards of printed squares, their corners in images, and which board it is that images show.

Sources: Garrido-Jurado and others, Automatic generation and detection of highly reliable fiducial markers (2014);
Duda and Frese, Accurate detection and localization of checkerboard corners for calibration (2018); both as OpenCV has
them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from fieldpose.errors import GeometryError
from fieldpose.stages.geometry.arrays import Matrix3, Pixels64
from fieldpose.stages.structure.markers import DICTIONARIES, Seen, find_markers

Kind = Literal["charuco", "chess"]
MARKER = 0.75
"""Side of a marker as a share of a square's: the white around it is then as wide as a cell of a 4x4 marker."""
FEWEST_CORNERS = 6
_OFF = 0.03
"""Of a square's side: so much a drawn marker may be larger or smaller than was asked for."""
_SPREAD = 0.4
"""Deviation in squares that a view's corners have at least in each direction: two rows of three have 0.5."""
_LEAST, _MOST = 3, 40
_FEWEST_MARKERS = 6
_MARKERS_WITHIN = 0.2
"""How far the middles of markers may be from where a board has them, in sides of a marker: a lens bends them a bit."""
_SHARE_WITHIN = 0.06


@dataclass(frozen=True)
class Board:
    """So many squares across and down, the first one black; a ChArUco board has a marker in each white one.

    marker: its side as a share of a square's. family: see stages/structure/markers.py. GeometryError for what makes no
    board.
    """

    kind: Kind
    across: int
    down: int
    marker: float = MARKER
    family: str = "4x4"

    def __post_init__(self) -> None:
        if not (_LEAST <= self.across <= _MOST and _LEAST <= self.down <= _MOST):
            raise GeometryError(f"a board has {_LEAST} to {_MOST} squares across and down, got {self.named}")
        if self.kind == "charuco":
            if not 0.3 <= self.marker <= 0.95:
                raise GeometryError(f"markers are 0.3 to 0.95 of a square, got {self.marker:.3g}")
            held = len(dictionary(self.family).bytesList)
            if self.markers > held:
                raise GeometryError(f"{self.named} squares need {self.markers} markers, but {self.family} has {held}")

    @property
    def named(self) -> str:
        """As users name it: squares across x down."""
        return f"{self.across}x{self.down}"

    @property
    def markers(self) -> int:
        """How many white squares there are."""
        return self.across * self.down // 2

    def corners(self) -> np.ndarray:
        """Where squares meet (n, 2), row by row, in squares from the board's own top left corner: x right, y down."""
        x, y = np.meshgrid(np.arange(1.0, self.across), np.arange(1.0, self.down))
        return np.stack([x.ravel(), y.ravel()], axis=1)


@dataclass(frozen=True, eq=False)
class View:
    """A board in an image: which of Board.corners() are seen (n,), and where, in pixels (n, 2)."""

    ids: np.ndarray
    pixels: Pixels64

    def board_to_image(self, board: Board) -> Matrix3:
        """The homography that takes the board's corners nearest to their pixels."""
        found, _ = cv2.findHomography(board.corners()[self.ids], self.pixels, 0)
        return np.eye(3) if found is None else np.asarray(found, np.float64)


class Finder:
    """Finds a board's corners in images; OpenCV's first pixel has its centre at 0 here, as ours."""

    def __init__(self, board: Board) -> None:
        self._board = board
        if board.kind == "charuco":
            aruco: Any = cv2.aruco
            parameters = aruco.DetectorParameters()
            parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
            drawn = aruco.CharucoBoard((board.across, board.down), 1.0, board.marker, dictionary(board.family))
            self._detector = aruco.CharucoDetector(drawn, aruco.CharucoParameters(), parameters)

    def __call__(self, grey: np.ndarray, exact: bool = True) -> View | None:
        """The corners in grey values (h, w) uint8; None where there are too few of them, or all in a line.

        exact: take the time that the best places of a chessboard's corners need.
        """
        view = self._charuco(grey) if self._board.kind == "charuco" else self._chess(grey, exact)
        if view is None or len(view.ids) < FEWEST_CORNERS:
            return None
        places = self._board.corners()[view.ids]
        spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) / np.sqrt(len(places))
        return view if spread[-1] > _SPREAD else None

    def _charuco(self, grey: np.ndarray) -> View | None:
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or not len(ids):
            return None
        return View(np.ravel(ids).astype(np.int64), np.reshape(corners, (-1, 2)).astype(np.float64))

    def _chess(self, grey: np.ndarray, exact: bool) -> View | None:
        size = (self._board.across - 1, self._board.down - 1)
        found, corners = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_ACCURACY if exact else 0)
        return View(np.arange(size[0] * size[1]), np.reshape(corners, (-1, 2)).astype(np.float64)) if found else None


def drawn(board: Board, side: int) -> np.ndarray:
    """The board (down * side, across * side) uint8, black and white, with squares of so many pixels.

    Cells of markers have whole pixels, so that a marker's side may be a little off. Raises GeometryError where squares
    have too few pixels for that.
    """
    white = (np.add.outer(np.arange(board.down), np.arange(board.across)) % 2 == 1).repeat(side, 0).repeat(side, 1)
    image = np.where(white, 255, 0).astype(np.uint8)
    if board.kind == "chess":
        return image
    markers = dictionary(board.family)
    cells = markers.markerSize + 2
    marker = round(board.marker * side / cells) * cells
    if abs(marker - board.marker * side) > _OFF * side or marker >= side:
        raise GeometryError(
            f"squares of {side} pixels are too small to draw their markers; print them larger, or finer"
        )
    border = (side - marker) // 2
    squares = [(y, x) for y in range(board.down) for x in range(board.across) if (x + y) % 2 == 1]
    for number, (y, x) in enumerate(squares):
        top, left = y * side + border, x * side + border
        image[top : top + marker, left : left + marker] = cv2.aruco.generateImageMarker(markers, number, marker)
    return image


def dictionary(family: str) -> Any:
    """OpenCV's dictionary of a family of markers."""
    aruco: Any = cv2.aruco
    return aruco.getPredefinedDictionary(getattr(aruco, DICTIONARIES[family]))


def seen_instead(board: Board, images: Sequence[np.ndarray]) -> str | None:
    """What images, (h, w) uint8, show in place of the board, and what to do about it; None where it is as said."""
    if board.kind == "chess":
        instead = _chess_instead(board, images)
        return None if instead is None else _family_instead(board, images) or instead
    shown = [find_markers(_coloured(image), board.family) for image in images]
    if max(map(len, shown), default=0) >= _FEWEST_MARKERS:
        return _charuco_instead(board, shown)
    if any(shown):
        return None
    return _family_instead(board, images) or _chess_instead(board, images)


def _family_instead(board: Board, images: Sequence[np.ndarray]) -> str | None:
    for family in DICTIONARIES:
        count = max((len(find_markers(_coloured(image), family)) for image in images), default=0)
        if count >= _FEWEST_MARKERS:
            kind = "" if board.kind == "charuco" else "--board charuco "
            return f"{count} markers of family {family} in one image; give {kind}--family {family}"
    return None


def _charuco_instead(board: Board, shown: Sequence[Sequence[Seen]]) -> str | None:
    most = max(shown, key=len)
    if len({marker.number for marker in most}) < len(most):
        return "the same marker more than once; show one board at a time"
    largest = max(marker.number for markers in shown for marker in markers)
    apart, across, first_black = min((_apart(most, across, first), across, first) for across, first in _layouts())
    if apart > _MARKERS_WITHIN:
        return "markers that lie as on no board of squares; print one with --print-board"
    if not first_black:
        return "a board whose first square is white, as OpenCV drew them before 4.6; print one with --print-board"
    if across != board.across or largest >= board.markers:
        down = max(next(rows for rows in range(1, 1000) if across * rows // 2 > largest), _LEAST)
        return f"a board of {across}x{down} squares; give --squares {across}x{down}"
    share = _share(most, across)
    if abs(share - board.marker) > _SHARE_WITHIN:
        return f"markers of {share:.2f} of a square, not {board.marker:.2f}; give --marker {share:.2f}"
    return None


def _layouts() -> Iterator[tuple[int, bool]]:
    return ((across, first_black) for across in range(_LEAST, _MOST + 1) for first_black in (True, False))


def _middles(numbers: np.ndarray, across: int, first_black: bool) -> np.ndarray:
    """Where a board has the middles of markers (n, 2), in squares."""
    rows = int(numbers.max()) // (across // 2) + 2
    y, x = np.divmod(np.arange(rows * across), across)
    white = ((x + y) % 2 == 1) if first_black else ((x + y) % 2 == 0)
    return np.stack([x[white], y[white]], axis=1)[numbers] + 0.5


def _apart(seen: Sequence[Seen], across: int, first_black: bool) -> float:
    """How far markers are from where such a board has them, root mean square, in sides of a marker."""
    at = np.stack([marker.corners.mean(axis=0) for marker in seen])
    middles = _middles(np.array([marker.number for marker in seen]), across, first_black)
    found, _ = cv2.findHomography(middles, at, 0)
    if found is None:
        return np.inf
    there = cv2.perspectiveTransform(middles[:, None], found)[:, 0]
    sides = np.stack([np.linalg.norm(m.corners - np.roll(m.corners, -1, axis=0), axis=1).mean() for m in seen])
    return float(np.sqrt(np.mean((np.linalg.norm(there - at, axis=1) / sides) ** 2)))


def _share(seen: Sequence[Seen], across: int) -> float:
    """Side of the markers, in squares."""
    at = np.stack([marker.corners.mean(axis=0) for marker in seen])
    found, _ = cv2.findHomography(at, _middles(np.array([marker.number for marker in seen]), across, True), 0)
    corners = cv2.perspectiveTransform(np.stack([marker.corners for marker in seen]), found)
    return float(np.median(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)))


def _chess_instead(board: Board, images: Sequence[np.ndarray]) -> str | None:
    """A chessboard of another size than the board, by the largest that an image shows."""
    size = (0, 0)
    for image in images:
        found, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), cv2.CALIB_CB_LARGER)
        if found and meta.size > size[0] * size[1]:
            size = (meta.shape[1], meta.shape[0])
    across, down = size[0] + 1, size[1] + 1
    if size == (0, 0) or (board.kind == "chess" and {across, down} == {board.across, board.down}):
        return None
    plain = "" if board.kind == "chess" else " --board chess"
    return (
        f"a chessboard of {across}x{down} squares ({size[0]}x{size[1]} inner corners); give{plain} --squares"
        f" {across}x{down}"
    )


def _coloured(grey: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)
