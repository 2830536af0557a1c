"""What `fieldpose doctor` looks at in a dataset: what is commonly wrong, and how to mend it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from fieldpose.deploy.cameras import fit_cameras, in_words, kept_in_words
from fieldpose.deploy.checks import Finding, Status
from fieldpose.errors import FieldposeError
from fieldpose.stages.geometry import Camera, nearest_point_to_axes
from fieldpose.stages.geometry.arrays import Transforms
from fieldpose.stages.nerf.datasets import Dataset, load_dataset
from fieldpose.stages.nerf.datasets.images import orientation
from fieldpose.stages.nerf.from_dataset import FEW
from fieldpose.stages.structure.selection import BLURRED, sharpness
from fieldpose.stages.structure.upright import distance_of_focus

_NAMED = 5
_ALIKE, _OFF_MIDDLE = 0.05, 0.2
"""Principal points of lenses are within a few percent of the middle; images are shrunk by a quarter and more."""
_ONE_WAY = 0.8
"""Length of the mean viewing direction, above which cameras face one way."""
_MANY_AWAY = 0.25
_LARGE_NUMBERS = 50.0
"""Units from what is looked at: nobody films things from so many metres, but from so many millimetres."""
_NEAREST_M, _FARTHEST_M = 0.01, 1000.0


def dataset(path: Path) -> Iterator[Finding]:
    """Whether a dataset can be read, every image of it, and its cameras are such as fit what the images show."""
    try:
        found = load_dataset(path, "all")
        sharp = [sharpness(cv2.cvtColor(found.load_rgb(i), cv2.COLOR_RGB2GRAY)) for i in range(len(found))]
    except FieldposeError as error:
        yield Finding("dataset", "failed", str(error))
        return
    test = sum(record.split == "test" for record in found.images)
    yield Finding(
        "dataset", "ok", f"{path}: {found.kind}, {found.scene}, {len(found) - test} train, {test} test images"
    )
    yield from (Finding("dataset", "note", note) for note in found.notes)
    yield from _images(found, np.array(sharp))
    yield from _lenses(found)
    yield from _places(found)
    yield from _cameras(found)


def _images(found: Dataset, sharp: np.ndarray) -> Iterator[Finding]:
    names = [record.name for record in found.images]
    copies = _copies(found)
    if copies:
        yield Finding("images", "warning", f"are there twice: {_listed(copies)}", "leave the copies out")
    if len(names) - sum(record.split == "test" for record in found.images) < FEW:
        yield Finding("images", "warning", "few to learn from", "take more, from more sides")
    blurred = [name for name, low in zip(names, sharp < BLURRED * np.median(sharp), strict=True) if low]
    if blurred:
        yield Finding(
            "images", "note", f"much less sharp than the others: {_listed(blurred)}", "leave them out if blurred"
        )
    turned = [record.name for record in found.images if orientation(record.path) != 1]
    if turned:
        yield Finding(
            "images", "note", f"turned by their EXIF orientation: {_listed(turned)}",
            "poses are taken to be of the pixels as they are stored, as COLMAP has them",
        )  # fmt: skip


def _cameras(found: Dataset) -> Iterator[Finding]:
    fit = fit_cameras(found, "auto").fit
    status: dict[str, Status] = {"fit": "ok", "adjusted": "note", "too few": "note", "no fit": "warning"}
    wrong = fit.reading is not None
    yield Finding("cameras", "warning" if wrong else status[fit.verdict], in_words(fit, found.unit))
    kept = kept_in_words(fit)
    if kept is not None:
        yield Finding("cameras", "note", kept)


def _lenses(found: Dataset) -> Iterator[Finding]:
    cameras = [record.camera for record in found.images]
    times = size_of_intrinsics(cameras)
    if times is not None:
        camera = cameras[0]
        size = f"{camera.width * times:.0f}x{camera.height * times:.0f}"
        yield Finding(
            "lens", "warning", f"the principal point is that of images {times:.3g} times as large, {size}, not of these"
            f" {camera.width}x{camera.height}", "scale focal length and principal point, or give w and h of theirs",
        )  # fmt: skip


def _places(found: Dataset) -> Iterator[Finding]:
    poses = np.stack([record.cam_from_object for record in found.images])
    away = share_looking_away(poses)
    if away > _MANY_AWAY:
        yield Finding(
            "places", "note", f"{away:.0%} of the cameras look away from what the others look at",
            "that is right within a room; around an object the axes or the order of rotations are not",
        )  # fmt: skip
    distance, metres = distance_of_focus(poses), found.metres_per_unit
    if metres is None and distance > _LARGE_NUMBERS:
        yield Finding(
            "places", "note", f"cameras are {distance:.0f} units from what they look at, in the median",
            "where these are millimetres, say so: metres_per_unit 0.001 in transforms.json, or `fieldpose frame`",
        )  # fmt: skip
    elif metres is not None and not _NEAREST_M < distance * metres < _FARTHEST_M:
        yield Finding(
            "places", "warning", f"by metres_per_unit cameras are {distance * metres:.3g} m from what they look at",
            "it is the length of one unit of the poses in metres: 0.001 for millimetres",
        )  # fmt: skip


def size_of_intrinsics(cameras: Sequence[Camera]) -> float | None:
    """How many times as large images are, by their cameras' principal points, whose middle these are.

    None where they are near the middle of these images, or of no images of their shape, as of crops.
    """
    across = float(np.median([(2 * c.cx + 1) / c.width for c in cameras]))
    down = float(np.median([(2 * c.cy + 1) / c.height for c in cameras]))
    alike = abs(across - down) < _ALIKE * max(across, down)
    return (across + down) / 2 if alike and abs(np.log((across + down) / 2)) > _OFF_MIDDLE else None


def share_looking_away(poses: Transforms) -> float:
    """Of cameras (n, 4, 4): those behind which is what most look at, the point nearest to all their axes.

    0 where they face one way, whose axes meet nowhere.
    """
    if np.linalg.norm(poses[:, 2, :3].mean(axis=0)) > _ONE_WAY:
        return 0.0
    focus = nearest_point_to_axes(list(poses))
    return float((poses[:, 2, :3] @ focus + poses[:, 2, 3] < 0).mean())


def _copies(found: Dataset) -> list[str]:
    """Names of images whose files another image's file equals."""
    seen: dict[bytes, str] = {}
    copies = []
    for record in found.images:
        digest = hashlib.sha256(record.path.read_bytes()).digest()
        if seen.setdefault(digest, record.name) != record.name:
            copies.append(f"{record.name} (as {seen[digest]})")
    return copies


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
