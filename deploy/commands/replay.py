"""Running a recording through the pipeline again."""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import tyro

from fieldpose.bus.messages import State
from fieldpose.bus.reading import RecordingInfo, info, read_recording
from fieldpose.bus.topics import STATE, Address
from fieldpose.deploy.commands.run import INTERRUPTED, check_recorded, planned
from fieldpose.deploy.graph import GRAPH, threads_of
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.processes.pipeline import run_pipeline
from fieldpose.deploy.processes.threads import hold_to
from fieldpose.deploy.replaying.feeding import CAMERA, Beginning, Feeding, compared, frames_before, starting_ns
from fieldpose.deploy.replaying.stepping import step_through
from fieldpose.deploy.replaying.verdict import Check, Closeness, Verdict
from fieldpose.deploy.reporting.gathering import recorded_pipeline
from fieldpose.deploy.reporting.output import check_writable, progress_console, result_console, write_json
from fieldpose.deploy.reporting.provenance import pipelines_in, recorded_cores, recorded_field, recorded_settings
from fieldpose.deploy.reporting.report import live_line, print_summary
from fieldpose.deploy.reporting.results import FrameResult, RunResult, spread, summarise
from fieldpose.deploy.settings import Settings, changed, read_file
from fieldpose.errors import RecordingError, UsageError
from fieldpose.stages.camera.config import Pace
from fieldpose.stages.geometry import Similarity, rotation_error_deg, translation_error
from fieldpose.stages.nerf.field import load_metadata

_DIFFERS = 1


@dataclass(frozen=True)
class Options:
    """Run a recording through the pipeline again, from its camera frames or from what one of the stages read, and tell
    how far what comes out is from what was recorded.

    Example: fieldpose replay out/lego.mcap --json out/replay.json
    Example: fieldpose replay out/lego.mcap --from guess --check exact

    Field and settings are those of the recording. From the camera, it is a run of processes like any other; from
    another topic its recorded messages are fed, one at a time and in this process, to the stages after it, without
    tracking. On one machine, both ways, the same comes out to the bit each time, and of a recording made in lockstep
    what was recorded. With --check the exit code is 1 where it does not.

    The JSON file has: compared (frames with a pose in both runs), only_recorded, only_replayed,
    rotation_difference_deg and translation_difference (each mean, median, p90, max; null without any), and replay (the
    keys of `fieldpose run`), of a replay from the camera; of all with --check or --from: check (asked, passed,
    complaints), fed, answered, topics (name -> both, same, only_recorded, only_replayed, fields (name -> messages,
    largest), rotation_deg, translation: the largest).
    """

    recording: tyro.conf.Positional[Path]
    """The recording (.mcap)."""
    beginning: Annotated[Beginning, tyro.conf.arg(name="from")] = "camera"
    """Where to begin: at the camera's frames, or at what one of the stages read."""
    check: Check | None = None
    """Fail unless all messages are the same in each bit (exact; for a recording made in lockstep, on a machine of its
    kind), or the poses are near each other (close)."""
    closeness: Annotated[Closeness, tyro.conf.arg(name="close")] = dataclasses.field(default_factory=Closeness)
    pipeline: str | None = None
    """OBJECT/CAMERA: which of its pipelines, where it holds several."""
    field: Path | None = None
    """Another field than the recording's."""
    config: Path | None = None
    """TOML or JSON file of settings that replace recorded ones."""
    pace: Pace | None = None
    """From the camera. lockstep: every frame, each when the one before has been answered, which is the default; live:
    at the recorded pace."""
    rate: float | None = None
    """From the camera and live: so many times as fast as it was recorded."""
    start: float = 0.0
    """Leave out what was captured in the first seconds, so many."""
    step: bool = False
    """Show each message and what comes of it, and wait for Enter before the next; in this process."""
    record: Path | None = None
    """From the camera: record this run too."""
    json: Path | None = None
    """Write the figures into this file."""

    def run(self) -> int:
        """Run, compare, print."""
        self._check_options()
        check_writable(self.record, self.json)
        recorded = info(self.recording)
        _check_pipeline(self.recording, self.pipeline, pipelines_in(recorded))
        address = recorded_pipeline(self.recording, self.pipeline)
        first_ns = starting_ns(self.recording, address, self.start)
        with tempfile.TemporaryDirectory(prefix="fieldpose-") as folder:
            used = self.field or recorded_field(self.recording, recorded, Path(folder), self.pipeline)
            if self.beginning != CAMERA or self.step:
                return self._feed(recorded, address, first_ns, used)
            return self._run_processes(recorded, address, first_ns, used, Path(folder))

    def _check_options(self) -> None:
        in_process = self.beginning != CAMERA or self.step
        for name in ("pace", "rate", "record"):
            if in_process and getattr(self, name) is not None:
                why = "--step" if self.step else f"--from {self.beginning}"
                raise UsageError(f"--{name} is for a replay of processes, from the camera, and not for {why}")
        if self.rate is not None and (not self.rate > 0 or self.pace not in (None, "live")):
            raise UsageError(f"--rate {self.rate:g} with --pace {self.pace or 'live'}: expected a rate above 0, live")
        if self.check != "close" and self.closeness != Closeness():
            raise UsageError("--close. tells how near is near enough for --check close; give that too")
        if not self.start >= 0:
            raise UsageError(f"--start {self.start:g}: expected seconds from 0 on")

    def _feed(self, recorded: RecordingInfo, address: Address, first_ns: int, used: Path) -> int:
        """Feed the stages in this process, with as many threads as the recorded ones had, for rounding hangs on it."""
        plan = planned(self._settings(0), used)
        cores = recorded_cores(recorded, self.pipeline)
        threads = max(threads_of(row, plan.in_flight, cores) for row in GRAPH)
        hold_to(threads)
        feeding = Feeding(self.recording, address, self.beginning, Parts(plan, threads=threads))
        ended = False
        try:
            if self.step:
                ended = not step_through(feeding.play(first_ns), print, _asked)
            else:
                for _ in _counted(feeding, first_ns):
                    pass
        finally:
            feeding.close()
        return self._judge(Verdict(feeding.fed, feeding.answered, feeding.comparison.topics()), {}, ended)

    def _run_processes(
        self, recorded: RecordingInfo, address: Address, first_ns: int, used: Path, folder: Path
    ) -> int:  # fmt: skip
        plan = planned(self._settings(frames_before(self.recording, address, first_ns)), used)
        record = self.record or (None if self.check is None else folder / "replay.mcap")
        with live_line("replay") as report:
            outcome = run_pipeline(plan, report, record)
        summary = summarise(outcome)
        print_summary(summary, f"replay of {self.recording}")
        comparison = self._comparison(recorded, address, first_ns, outcome, used, folder)
        _print(comparison, recorded)
        figures = {**comparison, "replay": summary}
        if self.check is None or record is None or outcome.interrupted:
            write_json(self.json, figures)
            check_recorded(outcome)
            return INTERRUPTED if outcome.interrupted else 0
        check_recorded(outcome)
        topics = compared(self.recording, record, address, first_ns).topics()
        # At its own pace frames are dropped at the door, and counted there.
        answered = outcome.sent if self.rate or self.pace == "live" else _answered(outcome)
        return self._judge(Verdict(outcome.sent, answered, topics), figures, ended=False)

    def _judge(self, verdict: Verdict, figures: Mapping[str, Any], ended: bool) -> int:
        """Print and write what came of it; the exit code."""
        console = result_console()
        if not ended:
            console.print(verdict.table())
        console.print(f"{verdict.fed} messages fed, {verdict.answered} answered", highlight=False)
        check = None if ended else self.check
        complaints = [] if check is None else verdict.complaints(check, self.closeness)
        said = {"asked": check, "passed": None if check is None else not complaints, "complaints": complaints}
        write_json(self.json, {**figures, "check": said, **verdict.figures()})
        for complaint in complaints:
            print(f"fieldpose: {self.recording}: {complaint}", file=sys.stderr)
        if check is not None and not complaints:
            console.print(f"check ({check}): passed", highlight=False)
        return _DIFFERS if complaints else 0

    def _comparison(
        self, recorded: RecordingInfo, address: Address, first_ns: int, outcome: RunResult, used: Path, folder: Path
    ) -> dict[str, Any]:
        now_from_then = self._change_of_frame(recorded, used, folder)
        then = recorded_poses(self.recording, address, first_ns)
        return compare({i: now_from_then.of_poses(p[None])[0] for i, p in then.items()}, outcome.frames)

    def _change_of_frame(self, recorded: RecordingInfo, used: Path, folder: Path) -> Similarity:
        """From the frame that recorded poses are in to that of the field that they are compared in."""
        if self.field is None:
            return Similarity.identity()
        try:
            before = load_metadata(recorded_field(self.recording, recorded, folder, self.pipeline)).frame
        except RecordingError:
            return Similarity.identity()
        return load_metadata(used).frame.object_from_dataset.after(before.object_from_dataset.inverse())

    def _settings(self, first: int) -> Settings:
        settings = recorded_settings(self.recording, self.pipeline)
        if self.config is not None:
            settings = changed(settings, read_file(self.config), str(self.config))
        pace = self.pace or ("lockstep" if self.rate is None else "live")
        # The frames are recorded as they were sent: shrunk, and with their camera.
        camera = replace(
            settings.camera, source=f"mcap:{self.recording}", size=None, camera_file=None, pace=pace, first=first,
            speed=self.rate or 1.0, every=1, frames=None, rate_hz=None, recorded=self.pipeline, objects=(),
        )  # fmt: skip
        return replace(settings, camera=camera)


def _counted(feeding: Feeding, first_ns: int) -> Iterator[None]:
    """Play it, showing how far it is."""
    console = progress_console()
    with console.status("replay") as status:
        for _ in feeding.play(first_ns):
            status.update(f"replay: {feeding.fed} messages fed, {feeding.answered} answered")
            yield


def _answered(outcome: RunResult) -> int:
    return sum(frame.outcome == "finished" for frame in outcome.frames)


def _asked(prompt: str) -> str:
    """What is answered at the terminal; where nothing can be, it goes on."""
    try:
        return input(prompt)
    except EOFError:
        return ""


def _check_pipeline(path: Path, wanted: str | None, held: Sequence[str]) -> None:
    if held and wanted not in held:
        raise UsageError(f"{path}: holds the pipelines {', '.join(held)}; choose one with --pipeline")
    if wanted is not None and not held:
        raise UsageError(f"{path}: holds one pipeline, which needs no --pipeline")


def recorded_poses(path: Path, address: Address, first_ns: int = 0) -> dict[int, np.ndarray]:
    """The measured pose of each frame from a capture time on, as tracking reported them. Raises RecordingError."""
    ours = (one for one in read_recording(path, (STATE,)) if address.covers(one.key))
    states = (cast(State, one.message) for one in ours if one.message.header.capture_ns >= first_ns)
    return {
        state.header.frame_id: np.array(state.cam_from_object)
        for state in states
        if state.cam_from_object is not None and state.score > 0
    }


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
