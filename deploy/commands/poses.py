"""The poses of a recording as files that other programs read."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from fieldpose.bus.reading import info
from fieldpose.deploy.reporting.gathering import recorded_results
from fieldpose.deploy.reporting.output import check_writable, write_bytes
from fieldpose.deploy.reporting.provenance import pipelines_in, recorded_field
from fieldpose.deploy.reporting.results import to_csv
from fieldpose.deploy.reporting.trajectories import PoseFiles, Trajectory, in_words
from fieldpose.errors import RecordingError, UsageError
from fieldpose.stages.nerf.field import load_metadata
from fieldpose.stages.nerf.metadata import FieldMetadata


@dataclass(frozen=True)
class Options:
    """Write the poses of a recording as files that other programs read, with the recorded times and cameras.

    Example: fieldpose poses out/lego.mcap --tum out/lego.tum --colmap out/lego-model

    Poses that tracking was sure of are written, and how many frames are left out is said; the CSV file has a row for
    each frame, with what was wrong with it, as of `fieldpose run`. TUM's trajectories hold object_from_cam, COLMAP's
    models cam_from_object and the frames' cameras, with the first pixel's centre at 0.5 as COLMAP has it. Lengths are
    in the field's unit, which is named in the trajectory.
    """

    recording: tyro.conf.Positional[Path]
    """The recording (.mcap)."""
    tum: Path | None = None
    """Write a trajectory of TUM's benchmark into this file: timestamp tx ty tz qx qy qz qw, in seconds."""
    colmap: Path | None = None
    """Write a COLMAP model (cameras.txt, images.txt, and points3D.txt without points) into this folder, which is to be
    empty or not there; images are named by their frame's number, as 00012.jpg."""
    csv: Path | None = None
    """Write a row for each frame into this file."""
    pipeline: str | None = None
    """OBJECT/CAMERA: which of its pipelines, where it holds several."""

    def run(self) -> int:
        """Write what was asked for, say how much it is."""
        if self.tum is None and self.colmap is None and self.csv is None:
            raise UsageError("nothing to write; give --tum, --colmap or --csv")
        field = self._field()
        moved = None if field is None else field.frame.object_from_dataset
        address, frames = recorded_results(self.recording, self.pipeline, moved)
        if field is None and any(frame.truth is not None for frame in frames):
            print("the recording does not hold its field, so in which frame true poses are is not known: left out")
            frames = [dataclasses.replace(frame, truth=None) for frame in frames]
        files = PoseFiles(self.tum, self.colmap)
        files.check()
        check_writable(self.csv)
        for line in files.write(Trajectory(address, in_words(field), frames)):
            print(line)
        if self.csv is not None:
            write_bytes(self.csv, to_csv([(address, frames)]))
            print(f"{self.csv}: {len(frames)} frames")
        return 0

    def _field(self) -> FieldMetadata | None:
        """What the recorded field says of itself; None where the recording has none."""
        recording = info(self.recording)
        pipeline = self.pipeline if pipelines_in(recording) else None
        with tempfile.TemporaryDirectory(prefix="fieldpose-") as folder:
            try:
                return load_metadata(recorded_field(self.recording, recording, Path(folder), pipeline))
            except RecordingError:
                return None
