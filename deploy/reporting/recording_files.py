"""A recording as files that other programs show: of Foxglove's schemas with a layout, and a video with the field."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fieldpose.bus.reading import info
from fieldpose.bus.topics import Address
from fieldpose.deploy.foxglove.extra import check_extra
from fieldpose.deploy.foxglove.layouts import layout, recorded_distance
from fieldpose.deploy.reporting.gathering import recorded_pipeline, recorded_results
from fieldpose.deploy.reporting.output import check_writable, progress_bar, write_bytes
from fieldpose.deploy.reporting.provenance import pipelines_in, recorded_field
from fieldpose.deploy.reporting.turntable import check_video
from fieldpose.errors import RecordingError, UsageError


@dataclass(frozen=True)
class RecordingFiles:
    """Where they go, None for nowhere. field: instead of the recorded one; pipeline: OBJECT/CAMERA, where several."""

    recording: Path
    foxglove: Path | None = None
    layout: Path | None = None
    video: Path | None = None
    field: Path | None = None
    pipeline: str | None = None
    backend: Literal["auto", "numba", "torch", "cuda"] = "auto"
    threads: int = 0

    def check(self) -> None:
        """Raise OutputError or UsageError where they could not be written later."""
        wanted = [path for path in (self.foxglove, self.layout, self.video) if path is not None]
        if not wanted:
            raise UsageError(
                f"nothing to write of the recording {self.recording}; give --foxglove, --layout or --video"
            )
        check_writable(self.foxglove, self.layout)
        check_video(self.video)
        if len({path.resolve() for path in (self.recording, *wanted)}) < 1 + len(wanted):
            raise UsageError("two of the files are the same; give the recording and each file a name of its own")
        if self.foxglove is not None:
            check_extra()

    def write(self) -> Iterator[str]:
        """Write them; gives a line about each. Raises RecordingError and OutputError."""
        if self.layout is not None:
            one = self.foxglove is not None or self.pipeline is not None
            address = recorded_pipeline(self.recording, self.pipeline) if one else None
            write_bytes(self.layout, layout(recorded_distance(self.recording, address)))
            yield f"{self.layout}: a layout, to be imported in Foxglove or Lichtblick"
        if self.foxglove is not None:
            yield self._foxglove(self.foxglove)
        if self.video is not None:
            yield self._video(self.video)

    def _foxglove(self, path: Path) -> str:
        from fieldpose.deploy.foxglove.exporting import export
        from fieldpose.stages.nerf.field import load_metadata

        address = recorded_pipeline(self.recording, self.pipeline)
        with self._field_of(address) as found:
            metadata = None if found is None else load_metadata(found)
        counts = export(self.recording, path, address, metadata)
        left_out = "" if metadata is not None else "; true poses are left out, since the field is not known (--field)"
        return f"{path}: {sum(counts.values())} messages of {address.pair}, {_megabytes(path)}{left_out}"

    def _video(self, path: Path) -> str:
        from fieldpose.deploy.reporting.showing import pictures, write_video
        from fieldpose.stages.nerf.field import load_metadata
        from fieldpose.stages.nerf.loading import load_renderer

        address = recorded_pipeline(self.recording, self.pipeline)
        with self._field_of(address) as found:
            if found is None:
                raise RecordingError(f"{self.recording}: holds no field to lay over its images; give --field FIELD")
            moved = load_metadata(found).frame.object_from_dataset
            _, results = recorded_results(self.recording, self.pipeline, moved)
            renderer = load_renderer(found, threads=self.threads, backend=self.backend)
        with progress_bar("export") as report:
            shown = pictures(
                self.recording, results, renderer, lambda done, total: report("rendering the video", done / total),
                address,
            )  # fmt: skip
            best = write_video(path, shown)
        if best is None:
            raise RecordingError(
                f"{self.recording}: no frame of {address.pair} was answered, so that there is no video"
            )
        return f"{path}: {_megabytes(path)}"

    @contextmanager
    def _field_of(self, address: Address) -> Iterator[Path | None]:
        """The field's file while the context lasts; None where it is neither recorded nor given."""
        with tempfile.TemporaryDirectory(prefix="fieldpose-") as folder:
            if self.field is not None:
                yield self.field
                return
            recording = info(self.recording)
            pipeline = address.pair if pipelines_in(recording) else None
            try:
                found = recorded_field(self.recording, recording, Path(folder), pipeline)
            except RecordingError:
                yield None
            else:
                yield found


def _megabytes(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.1f} MB"
