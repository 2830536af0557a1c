"""Whether a dataset's cameras fit its images; cameras that do where they do not; and both in words."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import numpy as np

from fieldpose.stages.nerf.datasets import Dataset, PosedCamera, load_dataset
from fieldpose.stages.nerf.datasets.images import load_mask, load_pixels, probe
from fieldpose.stages.nerf.from_dataset import FittedCameras
from fieldpose.stages.nerf.metadata import CameraFit

if TYPE_CHECKING:
    from fieldpose.stages.nerf.datasets.assemble import Holdout
    from fieldpose.stages.structure.mending import Mending, Spread
    from fieldpose.stages.structure.posed import PosedCameras

Cameras = Literal["auto", "given"]
"""auto: cameras that do not fit their images are adjusted to them; given: they are taken as they are."""
_NAMED = 5


def fit_cameras(
    dataset: Dataset,
    holdout: Holdout | None,
    threads: int = 0,
    report: Callable[[str, float], None] = lambda what, share: None,
) -> FittedCameras:
    """Compare a dataset's cameras with its images, both splits, and adjust them where that is worth it.

    dataset: its training images, at the size that they are to be trained on. holdout: as it was loaded with. threads: 0
    takes all cores. report: is told what is done and its share. Raises DatasetError.
    """
    from fieldpose.stages.structure.mending import LONGER_SIDE, mend
    from fieldpose.stages.structure.posed import PosedCameras

    trained_px = max(max(record.camera.width, record.camera.height) for record in dataset.images)
    dataset = load_dataset(dataset.root, "all", LONGER_SIDE, holdout=holdout)

    def load(index: int, width: int, height: int) -> np.ndarray:
        record = dataset.images[index]
        pixels = load_pixels(record.path, width, height, dataset.has_alpha)
        if record.learnt_path is None:
            return pixels
        learnt = np.where(load_mask(record.learnt_path, width, height), 255, 0).astype(np.uint8)
        alpha = learnt if not dataset.has_alpha else np.minimum(learnt, pixels[..., 3])
        return np.dstack([pixels[..., :3], alpha])

    given = PosedCameras(
        tuple(record.camera for record in dataset.images), np.stack([r.cam_from_object for r in dataset.images])
    )
    mending = mend(given, load, trained_px, threads, report)
    return FittedCameras(_record(dataset, given, mending), _adjusted(mending))


def in_words(fit: CameraFit, unit: str) -> str:
    """A line on how cameras fit, or how they were moved, or why not."""
    images = f"(in images of {fit.size_px} px)"
    if fit.reading is not None:
        return (
            "cameras do not fit their images: poses are read as object_from_cam in OpenGL's camera axes (x right, y up,"
            f" z back), but these would fit as {fit.reading}; write them in the former"
        )
    if fit.before_px is None or fit.after_px is None:
        return (
            f"whether the cameras fit their images is not known: {len(fit.kept)} images share too little with others;"
            " photographs with more overlap, more texture or more pixels would tell"
        )
    if fit.verdict == "fit":
        return (
            f"cameras fit their images: {fit.before_px:.2f} px {images}; adjusted, they would to {fit.after_px:.2f} px"
        )
    if fit.rotation_deg is None or fit.translation is None:
        return (
            f"cameras do not fit their images: {fit.before_px:.1f} px {images}, and none were found that do; are poses,"
            " focal length and lens those of these images, and does nothing move?"
        )
    (turned, turned_most), (moved, moved_most), (before, after) = fit.rotation_deg, fit.translation, fit.focal_px
    focal = f"focal length {before:.1f} -> {after:.1f} px, " if before != after else ""
    moved_by = (
        f"{turned:.2f} degrees and {moved:.3g} in the median, {turned_most:.2f} and {moved_most:.3g} at most"
        f" (lengths in: {unit})"
    )
    poses = moved_by if turned_most or moved_most else "poses stay"
    return (
        f"cameras adjusted to their images: {poses}, {focal}error {fit.before_px:.2f} -> {fit.after_px:.2f} px {images}"
    )


def kept_in_words(fit: CameraFit) -> str | None:
    """A line on adjusted datasets' images that keep their cameras; None where there are none."""
    if fit.verdict != "adjusted" or not fit.kept:
        return None
    names = ", ".join(fit.kept[:_NAMED]) + (", …" if len(fit.kept) > _NAMED else "")
    return f"{len(fit.kept)} images share too little with others and keep their cameras, as blurred ones do: {names}"


def _record(dataset: Dataset, given: PosedCameras, mending: Mending) -> CameraFit:
    names = [record.name for record in dataset.images]
    return CameraFit(
        verdict=mending.verdict,
        size_px=mending.size_px,
        focal_px=(_focal(dataset, given), _focal(dataset, mending.posed)),
        before_px=mending.before_px,
        after_px=mending.after_px,
        rotation_deg=_pair(mending.rotation_deg),
        translation=_pair(mending.translation),
        reading=mending.reading,
        kept=tuple(name for name, alone in zip(names, mending.unsupported, strict=True) if alone),
    )


def _focal(dataset: Dataset, posed: PosedCameras) -> float:
    """Median focal length at the size of the files."""
    headers = [probe(record.path) for record in dataset.images]
    sized = zip(posed.cameras, headers, strict=True)
    return float(np.median([camera.resized(header.width, header.height).fx for camera, header in sized]))


def _pair(spread: Spread | None) -> tuple[float, float] | None:
    return None if spread is None else (spread.median, spread.most)


def _adjusted(mending: Mending) -> list[PosedCamera] | None:
    if mending.verdict != "adjusted":
        return None
    posed = mending.posed
    return [PosedCamera(*pair) for pair in zip(posed.cameras, posed.cam_from_object, strict=True)]
