"""Whether given cameras fit their images, and cameras that do where they do not.

Both are told by tracks that nothing is adjusted to: one in five is held out, placed as well as it can be by the given
cameras and by the adjusted ones, and whichever leaves it nearer to its pixels has won, if by enough to be seen.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fieldpose.errors import GeometryError
from fieldpose.stages.cores import usable_cores
from fieldpose.stages.geometry import camera_centres, rotation_error_deg
from fieldpose.stages.geometry.arrays import Flags, Values
from fieldpose.stages.structure.adjustment import MEDIAN_LENGTH, adjust, supported
from fieldpose.stages.structure.colmap import Freedom, can_bend
from fieldpose.stages.structure.conventions import fitting_reading
from fieldpose.stages.structure.features import Keypoints, find_keypoints
from fieldpose.stages.structure.matches import match_pairs
from fieldpose.stages.structure.pairs import choose_pairs
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.tracks import SHORTEST, Tracks, join_tracks
from fieldpose.stages.structure.triangulation import triangulate

LONGER_SIDE = 800
"""Images are shrunk to this before keypoints are found, which are good to 0.4 px there: 0.03 degrees of most lenses."""
MOST_KEYPOINTS = 1500
"""Of an image. Twice as many leave cameras a tenth nearer to the truth (lego), in twice the time."""
HELD_OUT = 0.2
"""Of the tracks: of the few hundred that a small scene has, enough are left to adjust to, and to tell 5 % by."""
FEWEST_IMAGES = SHORTEST
LEAST_SUPPORTED = 0.5
"""Of the images: with fewer, what most of the field is learnt from would stay as it is."""
PIXEL_BLUR = 1 / np.sqrt(12)
"""Sigma of the mean over a pixel, in pixels, along each axis: errors of cameras that blur less are not seen."""
SURE_SIGMAS = 2.0
"""More held-out tracks must be better than worse by so many sigmas of a coin's toss: a chance of 1 in 44."""
LEAST_GAIN = 0.05
"""Of the error, where more of the cameras is adjusted. Matches have errors in common: lenses that are known leave up to
3 % more than those that they would have, which are 1 to 5 % longer or shorter (lego, fern, nine images of fox), where
10 % longer ones leave 6 % more, in the scene that shows it least."""
FITTING_PX = 3.0
"""Within this pairs of images agree, so cameras that leave more in the median do not explain them."""

FARTHEST_DEG = 20.0
"""In the median. Poses 15 degrees off still come right (fox); what turns cameras farther has followed something else,
like the background of an object on a turntable."""
_FAR_PX = 1e6
"""In place of the infinite error of a point behind its camera."""
Verdict = Literal["fit", "adjusted", "too few", "no fit"]


@dataclass(frozen=True)
class Spread:
    """Of several numbers."""

    median: float
    most: float


@dataclass(frozen=True, eq=False)
class Mending:
    """What became of given cameras.

    verdict: "fit", they stay, since others would not fit visibly better; "adjusted"; "too few" images share enough, or
    "no fit": none were found that explain the images; they stay. `before_px` and `after_px` are median distances of
    held-out points from their pixels, by the given cameras and the adjusted ones, in images whose longer side has
    `size_px` pixels; None where too few are shared. rotation_deg and translation (object units): how far adjusted
    cameras are from the given ones, both in the given frame. unsupported: images that stay as given since they share
    too little. reading: how the poses were meant, where none fit as they were read and would otherwise.
    """

    verdict: Verdict
    posed: PosedCameras
    size_px: int
    tracks: int
    unsupported: Flags
    before_px: float | None = None
    after_px: float | None = None
    rotation_deg: Spread | None = None
    translation: Spread | None = None
    reading: str | None = None


def mend(
    given: PosedCameras,
    load: Callable[[int, int, int], np.ndarray],
    trained_px: int | None = None,
    threads: int = 0,
    report: Callable[[str, float], None] = lambda what, share: None,
) -> Mending:
    """Adjust cameras to their images where that is worth it; else they come back to the bit.

    load: an image by its number, at a width and a height, (h, w, 3 or 4) uint8; keypoints are found within the alpha
    channel. trained_px: longer side of the images that the cameras are wanted for, by default these. threads: 0 takes
    all cores. report: is told what is done and its share.
    """
    small = PosedCameras(tuple(camera.shrunk(LONGER_SIDE) for camera in given.cameras), given.cam_from_object)
    threads = threads or usable_cores()
    keypoints = _find_keypoints(small, load, threads, report)
    pairs = choose_pairs(small.cam_from_object)
    matches = match_pairs(keypoints, pairs, threads, lambda share: report("matching the images", share))
    tracks = join_tracks(keypoints, pairs, matches)
    report("adjusting the cameras", 0.0)
    trained_px = trained_px or _longest(given)
    mending = _at_full_size(mend_by_tracks(small, tracks, min(trained_px, _longest(given)), threads), given)
    if mending.verdict in ("fit", "adjusted"):
        return mending
    trying = "trying other axes"
    return replace(mending, reading=fitting_reading(small, keypoints, threads, lambda share: report(trying, share)))


def _find_keypoints(
    posed: PosedCameras,
    load: Callable[[int, int, int], np.ndarray],
    threads: int,
    report: Callable[[str, float], None],
) -> list[Keypoints]:
    """Of images at the sizes of their cameras."""

    def found(index: int) -> Keypoints:
        camera = posed.cameras[index]
        return find_keypoints(load(index, camera.width, camera.height), MOST_KEYPOINTS)

    keypoints = []
    with ThreadPoolExecutor(threads) as pool:
        for points in pool.map(found, range(len(posed))):
            keypoints.append(points)
            report("looking for points in the images", len(keypoints) / len(posed))
    return keypoints


def mend_by_tracks(given: PosedCameras, tracks: Tracks, trained_px: float, threads: int = 1) -> Mending:
    """As mend, what the images share being known; trained_px by the sizes of the given cameras."""
    size_px = _longest(given)
    held_out = np.random.default_rng(0).random(tracks.count) < HELD_OUT
    shown, asked = tracks.chosen(~held_out), tracks.chosen(held_out)
    enough = supported(shown, len(given))
    if enough.sum() < max(FEWEST_IMAGES, LEAST_SUPPORTED * len(given)) or asked.count == 0:
        return Mending("too few", given, size_px, tracks.count, ~enough)
    with ThreadPoolExecutor(threads) as pool:
        lens, probe = pool.map(lambda freedom: _adjusted(given, shown, freedom, given), ("focal alone", "focal"))
    best = given if lens is None or not _gains(given, lens, asked) else lens
    before, least = triangulate(given, asked).error_px, triangulate(best, asked).error_px
    after = least if probe is None else triangulate(probe, asked).error_px
    if probe is not None and _seen(least, after, asked, PIXEL_BLUR * size_px / trained_px):
        best = _least_freed(given, probe, shown, asked, threads)
    if best is not given:
        after = least = triangulate(best, asked).error_px
    astray = np.median(least) > FITTING_PX or np.median(_turned_deg(given, best)) > FARTHEST_DEG
    verdict: Verdict = "no fit" if astray else "fit" if best is given else "adjusted"
    return _report(verdict, given, best, tracks.count, ~enough, before, after)


def _least_freed(given: PosedCameras, probe: PosedCameras, shown: Tracks, asked: Tracks, threads: int) -> PosedCameras:
    """The probe, or cameras of which less or more is adjusted: more only where held-out tracks gain by it.

    A focal length that was right stays by that to the bit, and one that was wrong does not make up for distortion.
    """
    as_calibrated = PosedCameras(given.cameras, probe.cam_from_object)
    with ThreadPoolExecutor(threads) as pool:
        poses = pool.submit(_adjusted, given, shown, "poses", as_calibrated)
        more = pool.submit(_adjusted, given, shown, "distortion", probe) if all(map(can_bend, given.cameras)) else None
        candidates = [poses.result(), probe, None if more is None else more.result()]
    possible = [candidate for candidate in candidates if candidate is not None]
    best = possible[0]
    for freer in possible[1:]:
        if _gains(best, freer, asked):
            best = freer
    return best


def _gains(best: PosedCameras, freer: PosedCameras, asked: Tracks) -> bool:
    before, after = (triangulate(cameras, asked).error_px for cameras in (best, freer))
    return bool(np.median(after) < (1 - LEAST_GAIN) * np.median(before)) and _surely(before, after, asked)


def _adjusted(given: PosedCameras, tracks: Tracks, freedom: Freedom, start: PosedCameras) -> PosedCameras | None:
    """None where what explains the tracks best makes no camera, or one that folds its image."""
    try:
        found = adjust(given, tracks, freedom, start)
        for camera in set(found.cameras):
            right, bottom = camera.width - 0.5, camera.height - 0.5
            camera.directions(np.array([(-0.5, -0.5), (right, -0.5), (-0.5, bottom), (right, bottom)]))
    except GeometryError:
        return None
    return found


def _seen(before: Values, after: Values, tracks: Tracks, blur_px: float) -> bool:
    """Whether errors of tracks are surely less, and by as much as is seen."""
    by_cameras = np.sqrt(max(float(np.median(before)) ** 2 - float(np.median(after)) ** 2, 0.0)) / MEDIAN_LENGTH
    return by_cameras > blur_px and _surely(before, after, tracks)


def _surely(before: Values, after: Values, tracks: Tracks) -> bool:
    was, now = (np.bincount(tracks.track, np.minimum(errors, _FAR_PX)) for errors in (before, after))
    return bool((now < was).sum() - (now > was).sum() > SURE_SIGMAS * np.sqrt(tracks.count))


def _report(
    verdict: Verdict, given: PosedCameras, found: PosedCameras, tracks: int, unsupported: Flags,
    before: Values, after: Values,
) -> Mending:  # fmt: skip
    turned = _turned_deg(given, found)
    moved = np.linalg.norm(camera_centres(given.cam_from_object) - camera_centres(found.cam_from_object), axis=1)
    adjusted = verdict == "adjusted"
    return Mending(
        verdict, found if adjusted else given, _longest(given), tracks, unsupported,
        float(np.median(before)), float(np.median(after)),
        Spread(float(np.median(turned)), float(turned.max())) if adjusted else None,
        Spread(float(np.median(moved)), float(moved.max())) if adjusted else None,
    )  # fmt: skip


def _turned_deg(given: PosedCameras, found: PosedCameras) -> Values:
    apart = zip(given.cam_from_object, found.cam_from_object, strict=True)
    return np.array([rotation_error_deg(a, b) for a, b in apart])


def _longest(posed: PosedCameras) -> int:
    return max(max(camera.width, camera.height) for camera in posed.cameras)


def _at_full_size(mending: Mending, given: PosedCameras) -> Mending:
    if mending.verdict != "adjusted":
        return replace(mending, posed=given)
    sized = zip(mending.posed.cameras, given.cameras, strict=True)
    cameras = tuple(small.resized(camera.width, camera.height) for small, camera in sized)
    return replace(mending, posed=PosedCameras(cameras, mending.posed.cam_from_object))
