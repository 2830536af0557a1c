"""Poses of a pipeline as files that other programs read: trajectories of TUM's benchmark, and models of COLMAP.

Only poses that tracking is sure of are in them. Source of the trajectories: Sturm and others, A benchmark for the
evaluation of RGB-D SLAM systems (2012).
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from fieldpose.bus.messages import TrackingState
from fieldpose.bus.topics import Address
from fieldpose.deploy.reporting.output import check_writable, write_bytes
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.errors import OutputError
from fieldpose.stages.geometry import inverse
from fieldpose.stages.nerf.metadata import FieldMetadata

_NS = 1_000_000_000


@dataclass(frozen=True)
class Trajectory:
    """The frames of one pipeline; unit: what its lengths are in, in words."""

    address: Address
    unit: str
    frames: Sequence[FrameResult]

    @property
    def sure(self) -> list[FrameResult]:
        """The frames with a measured pose while tracking was sure of it."""
        return [f for f in self.frames if f.cam_from_object is not None and f.state == TrackingState.TRACKING]

    def left_out(self) -> dict[str, int]:
        """How many frames are not among the sure ones, by why."""
        why = Counter("without a pose" if f.cam_from_object is None else str(f.state) for f in self.frames)
        return {reason: count for reason, count in why.items() if reason != TrackingState.TRACKING}

    @property
    def names(self) -> list[str]:
        """Of the sure frames' images: their numbers, with the time of those whose number is there twice."""
        counts = Counter(frame.frame_id for frame in self.sure)
        whens = [f"-{frame.capture_ns}" if counts[frame.frame_id] > 1 else "" for frame in self.sure]
        return [f"{frame.frame_id:05d}{when}.jpg" for frame, when in zip(self.sure, whens, strict=True)]


@dataclass(frozen=True)
class PoseFiles:
    """Where the poses of a pipeline go: a file for TUM's trajectory, a folder for COLMAP's model; None for nowhere."""

    tum: Path | None = None
    colmap: Path | None = None

    def check(self) -> None:
        """Raise OutputError where they could not be written later. COLMAP reads whatever else is in its folder."""
        folder = self.colmap
        if folder is not None and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"{folder}: is there already and not empty; name another folder, or remove it")
        if folder is not None and self.tum is not None and folder.resolve() == self.tum.resolve():
            raise OutputError(f"{folder}: is named for the trajectory and for the model; give each its own")
        check_writable(self.tum, None if folder is None or folder.is_dir() else folder)

    def write(self, trajectory: Trajectory) -> Iterator[str]:
        """Write them; gives a line about each. Raises OutputError."""
        if self.tum is not None:
            write_bytes(self.tum, to_tum(trajectory))
            yield f"{self.tum}: {_count(trajectory)}"
        if self.colmap is not None:
            missing = len(trajectory.sure) - _write_model(self.colmap, trajectory)
            yield f"{self.colmap}: {_count(trajectory)}{f'; {missing} of them without a camera' if missing else ''}"


def in_words(metadata: FieldMetadata | None) -> str:
    """What lengths are in, where the field is known that poses are relative to."""
    if metadata is None:
        return "the field's unit"
    metres = metadata.metres_per_unit
    return metadata.unit if metres is None else f"{metadata.unit} ({metres:g} m)"


def to_tum(trajectory: Trajectory) -> bytes:
    """A line `seconds tx ty tz qx qy qz qw` for each sure frame, oldest first: object_from_cam, at the capture time."""
    from scipy.spatial.transform import Rotation

    address = trajectory.address
    lines = [
        f"# object_from_cam: {address.camera} in the frame of {address.object}; camera axes x right, y down, z forward",
        f"# timestamp tx ty tz qx qy qz qw; seconds as the frames were stamped, lengths in {trajectory.unit}",
    ]
    for frame in trajectory.sure:
        assert frame.cam_from_object is not None
        pose = inverse(frame.cam_from_object)
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
        numbers = " ".join(repr(float(value)) for value in (*pose[:3, 3], *quaternion))
        lines.append(f"{frame.capture_ns // _NS}.{frame.capture_ns % _NS:09d} {numbers}")
    return ("\n".join(lines) + "\n").encode()


def _write_model(folder: Path, trajectory: Trajectory) -> int:
    """Returns how many poses the model has: those whose camera is known."""
    from fieldpose.stages.structure.colmap import ModelImage, model_text

    images = [
        ModelImage(name, frame.camera, frame.cam_from_object)
        for name, frame in zip(trajectory.names, trajectory.sure, strict=True)
        if frame.camera is not None and frame.cam_from_object is not None
    ]
    partial = folder.with_name(f"{folder.name}.partial")
    if partial.exists():
        raise OutputError(f"{partial}: an unfinished model is in the way; remove it")
    try:
        for name, text in model_text(images).items():
            write_bytes(partial / name, text.encode())
        os.replace(partial, folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return len(images)


def _count(trajectory: Trajectory) -> str:
    address, others = trajectory.address, trajectory.left_out()
    said = ", ".join(f"{count} {why}" for why, count in sorted(others.items()))
    left = f"; {sum(others.values())} frames left out ({said})" if others else ""
    return f"{len(trajectory.sure)} poses of {address.camera} in the frame of {address.object}{left}"
