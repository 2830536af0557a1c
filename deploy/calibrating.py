"""From a video or photographs of a printed board to the camera that took them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fieldpose.deploy.shots import FILMED_S, Report, cut_off, filmed, of_one_lens, opened, photographs
from fieldpose.errors import DatasetError, GeometryError
from fieldpose.stages.camera.boards import Board, Finder, View, seen_instead
from fieldpose.stages.camera.core import Source
from fieldpose.stages.camera.lenses import FEWEST_VIEWS, Lens, covered, descriptor, diverse, fit_lens, unseen
from fieldpose.stages.geometry import Camera
from fieldpose.stages.images import shrunk
from fieldpose.stages.nerf.datasets.images import orientation

_QUICK_SIDE = 960
"""Frames are looked through at this size, and at their own where they may be taken."""
_LOOKED_AT = 600
"""Frames of a video, evenly: a hand does not turn a board in a thirtieth of a second."""
_FINER = np.array([4.0, 4.0, 2.0, 16.0, 16.0])
"""Of the parts of a descriptor: of the views that are alike at this, the sharpest is kept."""
_SAMPLES = 12
_UNSURE_FOCAL = 0.003
_LARGE = 0.0005
"""An error, as a share of the image's longer side, that a flat board in focus does not have."""


@dataclass(frozen=True)
class Calibrated:
    """A camera that was found, in figures.

    seen: images; shown: those that show the board and were not too much like another; views: those that count.
    error_px: root mean square distance of corners from where they are seen. covered: share of the image's area that has
    been within a board's corners. tilt_deg: of the board against the image plane, at most. terms: of the distortion.
    """

    camera: Camera
    focal_sd_px: float
    error_px: float
    terms: str
    views: int
    shown: int
    seen: int
    covered: float
    tilt_deg: float
    notes: tuple[str, ...] = ()


def calibrate(
    source: str, board: Board, most: int, size: int | None = None, seconds: float = FILMED_S,
    report: Report = lambda what, share: None,
) -> Calibrated:  # fmt: skip
    """The camera of a source (a video, a folder of photographs, or any camera source) that shows a board.

    At most `most` views count, those that differ most. Images are shrunk to `size`, if one is given, and the camera is
    of images of that size. A live camera films for so many seconds, or until Ctrl-C. Raises SourceError where the
    source cannot be read, and DatasetError where it shows no such board, or not enough of it.
    """
    found = opened(source)
    gallery = _Gallery(board, size)
    if isinstance(found, Path):
        notes = _look_at_photographs(found, gallery, report)
    else:
        notes = _look_at_frames(found, gallery, seconds, report)
    # A marker that lies about is no reason where the board has been seen often enough.
    instead = seen_instead(board, gallery.samples) if len(gallery.views) < FEWEST_VIEWS else None
    if instead is not None:
        raise DatasetError(f"{source}: expected {_in_words(board)}, but the images show {instead}")
    if not gallery.views:
        whole = "whole, " if board.kind == "chess" else ""
        raise DatasetError(
            f"{source}: no board in any of {gallery.seen} images; expected {_in_words(board)}, {whole}flat and sharp"
        )
    report("finding the camera", 0.0)
    views = gallery.chosen(most)
    try:
        lens = fit_lens(board, views, *gallery.size)
    except GeometryError as error:
        raise DatasetError(f"{source}: {error}") from error
    report("finding the camera", 1.0)
    mask = covered([views[i] for i in lens.used], *gallery.size)
    return Calibrated(
        lens.camera, lens.focal_sd_px, lens.error_px, lens.terms, len(lens.used), len(gallery.views), gallery.seen,
        float(mask.mean()), float(lens.tilts_deg.max()), (*notes, *_lacking(lens, mask, len(views))),
    )  # fmt: skip


def _in_words(board: Board) -> str:
    if board.kind == "chess":
        return f"a chessboard of {board.named} squares ({board.across - 1}x{board.down - 1} inner corners)"
    return f"a ChArUco board of {board.named} squares with markers of family {board.family}"


def _look_at_photographs(folder: Path, gallery: _Gallery, report: Report) -> tuple[str, ...]:
    paths, left = photographs(folder)
    # Turned otherwise, the lens would be as well, and its principal point elsewhere.
    turned = {path: orientation(path) for path in paths}
    usual = Counter(turned.values()).most_common(1)[0][0]
    others = [path.name for path in paths if turned[path] != usual]
    for _, image, _ in of_one_lens(folder, [path for path in paths if turned[path] == usual], report):
        gallery.look(image, alone=True)
    if others:
        left += (f"{len(others)} photographs count for nothing, since the camera was held otherwise, as {others[0]}",)
    return left


def _look_at_frames(source: Source, gallery: _Gallery, seconds: float, report: Report) -> tuple[str, ...]:
    step, seen = max(1, (source.length or 0) // _LOOKED_AT), 0
    try:
        for image in filmed(source, seconds, report):
            if seen % step == 0:
                gallery.look(image)
            seen += 1
    except KeyboardInterrupt:
        if source.clock != "wall":
            raise
    return cut_off(source, seen)


class _Gallery:
    """Views of a board, of those that are much alike the sharpest, and some images to see what is there instead."""

    def __init__(self, board: Board, size: int | None) -> None:
        self._board, self._finder, self._size = board, Finder(board), size
        self._views: dict[tuple[int, ...], tuple[View, float]] = {}
        self._with, self._without = _Samples(), _Samples()
        self.size, self.seen = (0, 0), 0

    def look(self, image: np.ndarray, alone: bool = False) -> None:
        """Take in the next image (h, w, 3) uint8; one that stands alone is kept whatever others are like."""
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        grey = grey if self._size is None else shrunk(grey, self._size)
        self.size, self.seen = (grey.shape[1], grey.shape[0]), self.seen + 1
        small = shrunk(grey, _QUICK_SIDE)
        view = self._finder(grey) if alone else self._finder(small, exact=False)
        (self._without if view is None else self._with).add(small)
        if view is None:
            return
        sharp = _sharpness(grey if alone else small, view)
        likeness = descriptor(self._board, view, *(self.size if alone else (small.shape[1], small.shape[0])))
        key = (self.seen,) if alone else tuple(np.floor(likeness * _FINER).astype(int).tolist())
        if key in self._views and self._views[key][1] >= sharp:
            return
        exact = view if alone else self._finder(grey)
        if exact is not None:
            self._views[key] = (exact, sharp)

    @property
    def views(self) -> list[View]:
        return [view for view, _ in self._views.values()]

    @property
    def samples(self) -> list[np.ndarray]:
        """Images that show the board, or, where none does, some of all."""
        return self._with.images or self._without.images

    def chosen(self, most: int) -> list[View]:
        """At most so many views, that differ most from each other."""
        likeness = np.stack([descriptor(self._board, view, *self.size) for view in self.views])
        sharp = np.array([sharpness for _, sharpness in self._views.values()])
        return [self.views[i] for i in diverse(likeness, sharp, most)]


class _Samples:
    """Some images of many, evenly."""

    def __init__(self) -> None:
        self.images: list[np.ndarray] = []
        self._step, self._count = 1, 0

    def add(self, image: np.ndarray) -> None:
        if self._count % self._step == 0:
            self.images.append(image)
        self._count += 1
        if len(self.images) > _SAMPLES:
            self.images, self._step = self.images[::2], 2 * self._step


def _sharpness(grey: np.ndarray, view: View) -> float:
    from fieldpose.stages.structure.selection import sharpness

    (left, top), (right, bottom) = np.floor(view.pixels.min(axis=0)), np.ceil(view.pixels.max(axis=0)) + 1
    return sharpness(grey[max(int(top), 0) : int(bottom), max(int(left), 0) : int(right)])


def _lacking(lens: Lens, mask: np.ndarray, chosen: int) -> Iterator[str]:
    """What to film again, and why."""
    longer_side = max(lens.camera.width, lens.camera.height)
    if chosen > len(lens.used):
        yield f"{chosen - len(lens.used)} views were left out, which do not agree with the others"
    missing = unseen(mask)
    if missing:
        named = missing[0] if len(missing) == 1 else f"{', '.join(missing[:-1])} and {missing[-1]}"
        yield f"the board was not seen enough at the {named} of the image, where the lens is a guess; film it there too"
    if lens.focal_sd_px > _UNSURE_FOCAL * lens.camera.fx:
        yield (
            f"the focal length is known to {lens.focal_sd_px / lens.camera.fx:.1%} only; film the board nearer, and"
            " tilted by 30 to 45 degrees to each side"
        )
    if lens.error_px > _LARGE * longer_side:
        yield (
            f"an error of {lens.error_px:.1f} px is large; is the board flat, and filmed slowly, in focus, without zoom"
            " and stabilisation?"
        )
