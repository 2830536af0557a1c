"""What a field says of itself, in words."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fieldpose.deploy.cameras import in_words as fit_in_words
from fieldpose.deploy.evaluation.accuracy import in_words as accuracy_in_words
from fieldpose.stages.nerf.field import Field
from fieldpose.stages.nerf.metadata import FieldMetadata, Frame


def field_in_words(path: Path, field: Field) -> Iterator[str]:
    """Lines on what was learnt, how well, and the frame and unit of its poses."""
    about = field.metadata
    size = f"{path.stat().st_size / 1e6:.1f} MB"
    yield f"{path}: a field of {len(about.cameras)} training views ({about.dataset_kind}), {size}"
    yield f"  learnt in {about.trained_seconds:.0f} s, {about.trained_steps} steps, by {about.made_by or 'fieldpose'}"
    what = "the whole scene" if about.has_background else "an object alone, without what is around it"
    yield f"  holds {what}; " + (
        "held-out views were not rendered" if about.psnr_db is None else f"held-out views: {about.psnr_db:.1f} dB"
    )
    if about.accuracy is not None:
        yield f"  {accuracy_in_words(about.accuracy)}"
    if about.camera_fit is not None:
        yield f"  {fit_in_words(about.camera_fit, about.unit)}"
    yield f"  {frame_in_words(about)}"
    if about.cameras:
        focal = sorted(camera.fx for camera in about.cameras)[len(about.cameras) // 2]
        first = about.cameras[0]
        yield f"  cameras: {first.width}x{first.height}, focal length {focal:.0f} px, the first is {first.name}"


def frame_in_words(metadata: FieldMetadata) -> str:
    """A line: in which frame and unit poses are, and how that came from the dataset's."""
    metres = metadata.metres_per_unit
    unit = "lengths in metres" if metres == 1 else f"lengths in: {metadata.unit}"
    if metres is None:
        unit += "; how many metres that is, is not known"
    elif metres != 1:
        unit += f", of {metres:g} m"
    if metadata.frame == Frame():
        return f"frame of the dataset; {unit}"
    frame = metadata.frame.object_from_dataset
    turned = np.degrees(np.arccos(np.clip((np.trace(frame.rotation) - 1) / 2, -1, 1)))
    shift = ", ".join(f"{value:.4g}" for value in frame.translation)
    return (
        f"frame: the dataset's turned by {turned:.3g} degrees, scaled by {frame.scale:.6g}, moved by ({shift}); {unit}"
    )
