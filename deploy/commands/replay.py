"""Running the pipeline again on the frames of a recording."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import tyro

from fieldpose.bus.messages import State
from fieldpose.bus.replay import RecordingInfo, info, read_recording
from fieldpose.bus.topics import STATE
from fieldpose.deploy.commands.run import INTERRUPTED, planned
from fieldpose.deploy.processes.pipeline import run_pipeline
from fieldpose.deploy.reporting.output import check_writable, result_console, write_json
from fieldpose.deploy.reporting.provenance import pipelines_in, recorded_field, recorded_settings
from fieldpose.deploy.reporting.report import live_line, print_summary
from fieldpose.deploy.reporting.results import FrameResult, spread, summarise
from fieldpose.deploy.settings import Settings, changed, read_file
from fieldpose.errors import RecordingError, UsageError
from fieldpose.stages.camera.config import Pace
from fieldpose.stages.geometry import Similarity, rotation_error_deg, translation_error
from fieldpose.stages.nerf.field import load_metadata


@dataclass(frozen=True)
class Options:
    """Run the pipeline again on a recording's camera frames, and tell how far each pose is from the recorded one.

    Example: fieldpose replay out/lego.mcap --json out/replay.json

    Field and settings are those of the recording. The JSON file has: compared (frames with a pose in both runs),
    only_recorded, only_replayed, rotation_difference_deg and translation_difference (each mean, median, p90, max;
    null without any), and replay (the keys of `fieldpose run`).
    """

    recording: tyro.conf.Positional[Path]
    """The recording (.mcap)."""
    pipeline: str | None = None
    """OBJECT/CAMERA: which of its pipelines, where it holds several."""
    field: Path | None = None
    """Another field than the recording's."""
    config: Path | None = None
    """TOML or JSON file of settings that replace recorded ones."""
    pace: Pace = "lockstep"
    """lockstep: every frame, each when the one before has been answered; live: at the recorded pace."""
    record: Path | None = None
    """Record this run too."""
    json: Path | None = None
    """Write the figures into this file."""

    def run(self) -> int:
        """Run, compare, print."""
        check_writable(self.record, self.json)
        recorded = info(self.recording)
        _check_pipeline(self.recording, self.pipeline, pipelines_in(recorded))
        with tempfile.TemporaryDirectory(prefix="fieldpose-") as folder, live_line("replay") as report:
            field = self.field or recorded_field(self.recording, recorded, Path(folder), self.pipeline)
            outcome = run_pipeline(planned(self._settings(), field), report, self.record)
            now_from_then = self._change_of_frame(recorded, field, Path(folder))
        summary = summarise(outcome)
        then = recorded_poses(self.recording, self.pipeline)
        comparison = compare({i: now_from_then.of_poses(p[None])[0] for i, p in then.items()}, outcome.frames)
        print_summary(summary, f"replay of {self.recording}")
        _print(comparison, recorded)
        write_json(self.json, {**comparison, "replay": summary})
        return INTERRUPTED if outcome.interrupted else 0

    def _change_of_frame(self, recorded: RecordingInfo, field: Path, folder: Path) -> Similarity:
        """From the frame that recorded poses are in to that of the field that they are compared in."""
        if self.field is None:
            return Similarity.identity()
        try:
            before = load_metadata(recorded_field(self.recording, recorded, folder, self.pipeline)).frame
        except RecordingError:
            return Similarity.identity()
        return load_metadata(field).frame.object_from_dataset.after(before.object_from_dataset.inverse())

    def _settings(self) -> Settings:
        settings = recorded_settings(self.recording, self.pipeline)
        if self.config is not None:
            settings = changed(settings, read_file(self.config), str(self.config))
        # The frames are recorded as they were sent: shrunk, and with their camera.
        camera = replace(settings.camera, source=f"mcap:{self.recording}", size=None, camera_file=None, pace=self.pace)
        camera = replace(camera, recorded=self.pipeline, objects=())
        return replace(settings, camera=camera)


def _check_pipeline(path: Path, wanted: str | None, held: Sequence[str]) -> None:
    if held and wanted not in held:
        raise UsageError(f"{path}: holds the pipelines {', '.join(held)}; choose one with --pipeline")
    if wanted is not None and not held:
        raise UsageError(f"{path}: holds one pipeline, which needs no --pipeline")


def recorded_poses(path: Path, pipeline: str | None = None) -> dict[int, np.ndarray]:
    """The measured pose of each frame of a recording, as its tracking reported them. Raises RecordingError."""
    everything = read_recording(path, (STATE,))
    states = (cast(State, one.message) for one in everything if pipeline is None or _is_of(one.key, pipeline))
    return {
        state.header.frame_id: np.array(state.cam_from_object)
        for state in states
        if state.cam_from_object is not None and state.score > 0
    }


def _is_of(key: str, pipeline: str) -> bool:
    sender = STATE.address_of(key)
    return sender is not None and sender.pair == pipeline


def compare(recorded: Mapping[int, np.ndarray], results: Sequence[FrameResult]) -> dict[str, Any]:
    """How far poses of the same frame are apart, under the keys that `Options` documents."""
    replayed = {r.frame_id: r.cam_from_object for r in results if r.cam_from_object is not None}
    both = sorted(recorded.keys() & replayed.keys())
    turns = [rotation_error_deg(recorded[i], replayed[i]) for i in both]
    shifts = [translation_error(recorded[i], replayed[i]) for i in both]
    return {
        "compared": len(both),
        "only_recorded": len(recorded.keys() - replayed.keys()),
        "only_replayed": len(replayed.keys() - recorded.keys()),
        "rotation_difference_deg": _with_max(turns),
        "translation_difference": _with_max(shifts),
    }


def _with_max(values: list[float]) -> dict[str, float] | None:
    found = spread(values)
    return None if found is None else {**found, "max": max(values)}


def _print(comparison: Mapping[str, Any], recorded: RecordingInfo) -> None:
    console = result_console()
    counts = "frames with both poses: {compared}, only the recorded: {only_recorded}, only the new: {only_replayed}"
    console.print(counts.format(**comparison), highlight=False)
    for key, what, unit in (
        ("rotation_difference_deg", "rotation", "deg"),
        ("translation_difference", "translation", "units"),
    ):
        if comparison[key] is not None:
            text = ", ".join(f"{name} {value:.4g}" for name, value in comparison[key].items())
            console.print(f"from the recorded poses, {what}: {text} {unit}", highlight=False)
    if not recorded.lossless:
        console.print("the recording is not lossless: `fieldpose info` tells what it lacks", highlight=False)
