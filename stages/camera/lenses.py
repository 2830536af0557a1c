"""A camera from views of a flat board: which views to take, the lens that fits them, and how sure it is.

Sources: Zhang, A flexible new technique for camera calibration (2000), as OpenCV has it; Kannala and Brandt, A generic
camera model (2006), for lenses that the pinhole camera does not fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fieldpose.errors import GeometryError
from fieldpose.stages.camera.boards import Board, View
from fieldpose.stages.geometry import Camera
from fieldpose.stages.geometry.arrays import Transforms
from fieldpose.stages.nerf.datasets.intrinsics import check_invertible

FEWEST_VIEWS = 8
_FIXED_K = (cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2, cv2.CALIB_FIX_K3)
_MODELS: dict[str, int] = {
    "none": sum(_FIXED_K) | cv2.CALIB_ZERO_TANGENT_DIST,
    "k1": _FIXED_K[1] | _FIXED_K[2] | cv2.CALIB_ZERO_TANGENT_DIST,
    "k1 k2": _FIXED_K[2] | cv2.CALIB_ZERO_TANGENT_DIST,
    "k1 k2 p1 p2": _FIXED_K[2],
    "k1 k2 p1 p2 k3": 0,
}
_FOLDS = 5
_SURE = 2.0
"""Standard errors by which the views that are left out must be fitted better for a lens to have more coefficients."""
_OUTLYING, _SLIGHT_PX = 3.0, 0.3
"""A view is dropped whose error is so many times the median's, and not slight."""
_DROPPED_AT_MOST, _ROUNDS = 1 / 3, 5
_UNSURE = 0.02
"""Of the focal length: a standard deviation beyond which it is not known."""
_OPEN = (
    "the views leave the focal length open, since the board is parallel to the image or far away in most; film it near,"
    " and tilted by 30 to 45 degrees to each side"
)
_OTHER_FOCALS, _SURELY_WORSE = (0.9, 1.1), 25.0
"""Focal lengths as shares of the best one that must fit worse, by so many times the variance of a corner."""
_POOR = 0.0005
"""An error, as a share of the image's longer side, that a flat board in focus has not, if the lens is a pinhole's."""
_FAR_BETTER = 0.5
"""Of the pinhole camera's error: what a fisheye's is below, where the lens is one."""
_NONE = 0.005
"""An error, as a share of the longer side, by which no lens fits."""
_STARTS, _FISHEYE_STARTS = (1.2, 0.6, 3.0), (0.8, 0.5, 0.3)
"""Focal lengths over the longer side to begin with."""
_TALL, _SEEN = 48, 0.25
"""Cells of the image's shorter side when the area that a board has covered is counted, and the share of a ninth of the
image that is enough of it: corners never reach the very border."""


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera that fits views: coefficients in words; standard deviation of its focal length, and error, in pixels.

    error_px: root mean square distance of corners from where they are seen. used: indices of the views that count.
    cam_from_board: (n, 4, 4) of these, in squares.
    """

    camera: Camera
    terms: str
    focal_sd_px: float
    error_px: float
    used: tuple[int, ...]
    cam_from_board: Transforms

    @property
    def tilts_deg(self) -> np.ndarray:
        """Angles (n,) between the board and the image plane."""
        return np.degrees(np.arccos(np.clip(self.cam_from_board[:, 2, 2], -1, 1)))


@dataclass(frozen=True, eq=False)
class _Fit:
    matrix: np.ndarray
    lens: np.ndarray
    error_px: float
    focal_sd_px: float
    rotations: np.ndarray
    offsets: np.ndarray


def descriptor(board: Board, view: View, width: int, height: int) -> np.ndarray:
    """What tells views apart (5,): place x and y as shares of the image, log2 of the size, differences in depth.

    These are half the relative ones across and down the board, by its perspective alone, whatever the lens.
    """
    homography = view.board_to_image(board)
    middle = np.array([board.across / 2, board.down / 2, 1.0])
    depth = homography[2] @ middle
    across, down = homography[2, :2] * (board.across, board.down) / (2 * depth)
    x, y = view.pixels.mean(axis=0)
    side = np.sqrt(abs(np.linalg.det(homography / depth)))
    return np.array([(x + 0.5) / width, (y + 0.5) / height, np.log2(side / max(width, height)), across, down])


def diverse(descriptors: np.ndarray, sharpness: np.ndarray, most: int) -> list[int]:
    """At most so many of views (n, 5), each in turn the one that is least like those taken, the sharpest first."""
    if len(descriptors) <= most:
        return list(range(len(descriptors)))
    scaled = descriptors * (2.0, 2.0, 1.0, 4.0, 4.0)
    taken = [int(np.argmax(sharpness))]
    distance = np.linalg.norm(scaled - scaled[taken[0]], axis=1)
    while len(taken) < most:
        taken.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(scaled - scaled[taken[-1]], axis=1))
    return sorted(taken)


def covered(views: Sequence[View], width: int, height: int) -> np.ndarray:
    """Which cells (rows, columns) of the image have been within the corners of a view."""
    scale = _TALL / min(width, height)
    mask = np.zeros((max(1, round(height * scale)), max(1, round(width * scale))), np.uint8)
    for view in views:
        hull = cv2.convexHull(((view.pixels + 0.5) * scale - 0.5).astype(np.float32))
        cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), 1)
    return mask.astype(bool)


def unseen(mask: np.ndarray) -> list[str]:
    """Which ninths of the image, in words, `covered` has too little of."""
    rows, columns = (np.linspace(0, count, 4).astype(int) for count in mask.shape)
    return [
        " ".join(filter(None, (vertical, horizontal))) or "middle"
        for i, vertical in enumerate(("top", "", "bottom"))
        for j, horizontal in enumerate(("left", "", "right"))
        if mask[rows[i] : rows[i + 1], columns[j] : columns[j + 1]].mean() < _SEEN
    ]


def fit_lens(board: Board, views: Sequence[View], width: int, height: int) -> Lens:
    """The pinhole camera of images of that size, with the coefficients that views which are left out speak for.

    Views that fit far worse than the others are dropped. GeometryError where there are too few views, where they leave
    the focal length open, or where no pinhole camera fits them.
    """
    _check_enough(views, "show the board")
    fitting = _Fitting(board, width, height)
    used = fitting.agreeing(views)
    chosen = [views[i] for i in used]
    _check_enough(chosen, "agree with each other")
    fits = {model: fitting.fit(model, chosen) for model in _MODELS}
    terms = _best(fitting, fits, chosen)
    fit = fits[terms]
    if fit.error_px > _POOR * max(width, height):
        _check_pinhole(fitting, min(fit.error_px for fit in fits.values()), chosen, max(width, height))
    camera = fitting.camera(fit)
    if fit.focal_sd_px > _UNSURE * camera.fx or fitting.leaves_focal_open(terms, fit, chosen):
        raise GeometryError(_OPEN)
    poses = np.stack([_pose(r, t) for r, t in zip(fit.rotations, fit.offsets, strict=True)])
    return Lens(camera, terms, fit.focal_sd_px, fit.error_px, tuple(used), poses)


def _check_enough(views: Sequence[View], what: str) -> None:
    if len(views) < FEWEST_VIEWS:
        raise GeometryError(
            f"{len(views)} views {what}, but at least {FEWEST_VIEWS} are needed; film it longer, sharp, flat and from"
            " more sides"
        )


def _check_pinhole(fitting: _Fitting, error_px: float, views: Sequence[View], longer_side: int) -> None:
    if fitting.fisheye_error_px(views) < _FAR_BETTER * error_px:
        raise GeometryError(
            f"a fisheye lens, which is not supported (a pinhole camera is {error_px:.1f} px off); film in the camera's"
            " linear mode"
        )
    if error_px > _NONE * longer_side:
        raise GeometryError(
            f"no lens fits (the best is {error_px:.1f} px off); is the board flat, and filmed without zoom and"
            " stabilisation, in the camera's linear mode?"
        )


class _Fitting:
    def __init__(self, board: Board, width: int, height: int) -> None:
        self._places = np.pad(board.corners(), ((0, 0), (0, 1))).astype(np.float32)
        self._size = (width, height)
        self._start: np.ndarray | None = None

    def fit(self, model: str, views: Sequence[View]) -> _Fit:
        """Raises GeometryError where nothing fits."""
        starts = [self._start] if self._start is not None else [self._matrix(share) for share in _STARTS]
        fits = [fit for fit in (self._from(start, model, views) for start in starts) if fit is not None]
        if not fits:
            held = self._from(starts[0], model, views, cv2.CALIB_FIX_FOCAL_LENGTH)
            raise GeometryError(_OPEN if held is not None else "no camera fits the views; is the board flat?")
        best = min(fits, key=lambda fit: fit.error_px)
        self._start = best.matrix if self._start is None else self._start
        return best

    def agreeing(self, views: Sequence[View]) -> list[int]:
        """Which views one lens with all coefficients fits, none of them far worse than most."""
        used = list(range(len(views)))
        for _ in range(_ROUNDS):
            fit = self.fit(list(_MODELS)[-1], [views[i] for i in used])
            errors = np.sqrt([self._posed_error(fit, view) for view in views])
            good = np.flatnonzero(errors <= max(_OUTLYING * float(np.median(errors)), _SLIGHT_PX)).tolist()
            if good == used or len(good) < (1 - _DROPPED_AT_MOST) * len(views):
                break
            used = good
        return used

    def leaves_focal_open(self, model: str, fit: _Fit, views: Sequence[View]) -> bool:
        """Whether other focal lengths fit about as well: then derivatives at the best one tell nothing."""
        worse = []
        for share in _OTHER_FOCALS:
            start = fit.matrix * [[share, 1, 1], [1, share, 1], [1, 1, 1]]
            other = self._from(start, model, views, cv2.CALIB_FIX_FOCAL_LENGTH)
            squared = np.inf if other is None else (other.error_px / fit.error_px) ** 2 - 1
            worse.append(2 * sum(len(view.ids) for view in views) * squared)
        return min(worse) < _SURELY_WORSE

    def _from(self, start: np.ndarray, model: str, views: Sequence[View], flags: int = 0) -> _Fit | None:
        places, pixels = [self._places[view.ids] for view in views], [view.pixels.astype(np.float32) for view in views]
        flags |= _MODELS[model] | cv2.CALIB_USE_INTRINSIC_GUESS
        try:
            error, matrix, lens, rotations, offsets, deviations, _, _ = cv2.calibrateCameraExtended(
                places, pixels, self._size, start.copy(), np.zeros(5), flags=flags
            )
        except cv2.error:
            return None
        if not (np.isfinite(error) and np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
            return None
        return _Fit(
            matrix, lens.ravel()[:5], float(error), float(deviations[0, 0]),
            np.reshape(rotations, (-1, 3)), np.reshape(offsets, (-1, 3)),
        )  # fmt: skip

    def left_out_errors(self, model: str, views: Sequence[View]) -> np.ndarray:
        """Mean squared errors of views, each by a lens that the others have told."""
        errors = np.zeros(len(views))
        for fold in range(_FOLDS):
            apart = range(fold, len(views), _FOLDS)
            fit = self.fit(model, [view for i, view in enumerate(views) if i % _FOLDS != fold])
            for i in apart:
                errors[i] = self._posed_error(fit, views[i])
        return errors

    def _posed_error(self, fit: _Fit, view: View) -> float:
        """Mean squared error of a view whose pose is found by a lens that is given; infinite where there is none."""
        places = self._places[view.ids]
        try:
            _, rotation, offset = cv2.solvePnP(places, view.pixels, fit.matrix, fit.lens)
        except cv2.error:
            return np.inf
        there, _ = cv2.projectPoints(places, rotation, offset, fit.matrix, fit.lens)
        return float(np.mean(np.sum((there[:, 0] - view.pixels) ** 2, axis=1)))

    def fisheye_error_px(self, views: Sequence[View]) -> float:
        """Of a fisheye lens that fits the views; infinite where none does."""
        fisheye: Any = cv2.fisheye
        # OpenCV 4 has the names in its module for fisheyes.
        named = fisheye if hasattr(fisheye, "CALIB_FIX_SKEW") else cv2
        flags = named.CALIB_RECOMPUTE_EXTRINSIC | named.CALIB_FIX_SKEW | named.CALIB_USE_INTRINSIC_GUESS
        places = [self._places[view.ids][None].astype(np.float64) for view in views]
        pixels = [view.pixels[None] for view in views]
        errors = [np.inf]
        for start in map(self._matrix, _FISHEYE_STARTS):
            with suppress(cv2.error):
                errors.append(float(fisheye.calibrate(places, pixels, self._size, start, np.zeros(4), flags=flags)[0]))
        return min(errors)

    def _matrix(self, share: float) -> np.ndarray:
        width, height = self._size
        focal = share * max(self._size)
        return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])

    def camera(self, fit: _Fit) -> Camera:
        (fx, _, cx), (_, fy, cy), _ = fit.matrix.tolist()
        k1, k2, p1, p2, k3 = fit.lens.tolist()
        return Camera(*self._size, fx, fy, cx, cy, (k1, k2, p1, p2, k3))


def _best(fitting: _Fitting, fits: Mapping[str, _Fit], views: Sequence[View]) -> str:
    """The model with the fewest coefficients than which none with more fits views that are left out surely better.

    Those that fold the image's corners over are none: nothing is seen there, or another model is as good.
    """
    best, *others = [model for model, fit in fits.items() if _invertible(fitting.camera(fit))]
    errors = fitting.left_out_errors(best, views)
    for model in others:
        found = fitting.left_out_errors(model, views)
        better = errors - found
        if better.mean() > _SURE * better.std() / np.sqrt(len(better)):
            best, errors = model, found
    return best


def _invertible(camera: Camera) -> bool:
    try:
        check_invertible(camera)
    except GeometryError:
        return False
    return True


def _pose(rotation: np.ndarray, offset: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], offset
    return pose
