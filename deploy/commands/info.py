"""What a recording holds, or a field says of itself."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import tyro
from rich.table import Table

from fieldpose.bus.mcap_files import PART_RECORD, RECORDING_RECORD, SNAPSHOT_RECORD
from fieldpose.bus.messages import CameraInfo
from fieldpose.bus.reading import RecordingInfo, info, read_recording
from fieldpose.bus.topics import CAMERA_INFO
from fieldpose.deploy.reporting.output import result_console, write_json
from fieldpose.deploy.reporting.provenance import EDIT_RECORD, PLAN_RECORD, RUN_RECORD
from fieldpose.deploy.reporting.report import CAMERA_ORIGINS

FIELD_SUFFIX = ".safetensors"


@dataclass(frozen=True)
class Options:
    """List what a recording holds, topic by topic, with what each sender's own numbers say is missing; or what a field
    says of itself: how well it was learnt, and in which frame and unit its poses are.

    Example: fieldpose info out/lego.mcap

    The JSON file of a field has what its file says besides the arrays. That of a recording has: path, size_bytes,
    messages, first_ns, last_ns, lossless, topics (key, topic, messages, first_ns, last_ns, rate_hz), sources (key,
    source, received, written, missing), metadata, attachments (bytes), cameras (where the intrinsics of frames come
    from -> how many).
    """

    file: tyro.conf.Positional[Path]
    """The recording (.mcap) or the field (.safetensors)."""
    json: Path | None = None
    """Write the same into this file."""

    def run(self) -> int:
        """Print what it is."""
        if self.file.suffix == FIELD_SUFFIX:
            return self._field()
        recording, cameras = info(self.file), _cameras(self.file)
        write_json(self.json, {**asdict(recording), "cameras": cameras})
        console = result_console()
        console.print("\n".join(_description(recording, cameras)), highlight=False, soft_wrap=True)
        console.print(_topics(recording))
        return 0

    def _field(self) -> int:
        from fieldpose.deploy.reporting.fields import field_in_words
        from fieldpose.stages.nerf.field import load_field

        field = load_field(self.file)
        write_json(self.json, field.metadata)
        result_console().print("\n".join(field_in_words(self.file, field)), highlight=False, soft_wrap=True)
        return 0


def _cameras(path: Path) -> dict[str, int]:
    """Where the intrinsics of the frames come from, and of how many."""
    infos = (cast(CameraInfo, recorded.message) for recorded in read_recording(path, (CAMERA_INFO,)))
    return dict(Counter(str(info.camera_origin) for info in infos))


def _description(recording: RecordingInfo, cameras: Mapping[str, int]) -> Iterator[str]:
    seconds = (recording.last_ns - recording.first_ns) / 1e9
    began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(recording.first_ns / 1e9))
    size = f"{recording.size_bytes / 1e6:.1f} MB"
    yield f"{recording.path}: {recording.messages} messages in {seconds:.1f} s from {began}, {size}"
    yield "no message lost" if recording.lossless else f"NOT LOSSLESS{_why(recording)}"
    yield from _origin(recording)
    yield from _noted(recording, RUN_RECORD, "")
    yield from (f"  camera {CAMERA_ORIGINS[origin]}: {count} frames" for origin, count in cameras.items())
    yield from _noted(recording, PLAN_RECORD, "planned: ")
    yield from _noted(recording, EDIT_RECORD, "edited: ")
    yield from (f"  attached: {name} ({count} bytes)" for name, count in recording.attachments.items())


def _origin(recording: RecordingInfo) -> Iterator[str]:
    """Whether it is a part of a longer one, or was kept for a snapshot."""
    part, snapshot = recording.metadata.get(PART_RECORD), recording.metadata.get(SNAPSHOT_RECORD)
    if part is not None:
        kept = "no message lost between them" if recording.lossless else "what is missing here may be between them"
        yield f"  part {part['part']} of a recording, goes on with {part['before']}; {kept}"
    if snapshot is not None:
        why = "when tracking was lost" if snapshot["why"] == "lost" else "when it was asked for"
        yield f"  a snapshot of the last {float(snapshot['seconds']):.1f} s, saved {why}"


def _noted(recording: RecordingInfo, record: str, what: str) -> Iterator[str]:
    """What stands in the records of a name, those of each of several pipelines after it."""
    for name, values in recording.metadata.items():
        if name == record or name.startswith(f"{record} "):
            whose = name.removeprefix(record).strip()
            yield from (f"  {whose}{': ' if whose else ''}{what}{key}: {value}" for key, value in values.items())


def _why(recording: RecordingInfo) -> str:
    noted = recording.metadata.get(RECORDING_RECORD, {})
    reasons = []
    missing = sum(source.missing for source in recording.sources)
    unwritten = sum(source.received - source.written for source in recording.sources)
    if missing or unwritten:
        reasons.append(f"{missing} messages did not come, {unwritten} came and found no room")
    if noted.get("refused", "0") != "0":
        reasons.append(f"{noted['refused']} were refused")
    if recording.ended is not None:
        reasons.append(f"it ended early ({recording.ended})")
    if "damage" in noted:
        reasons.append(f"recovered from a damaged file ({noted['damage']})")
    return ": " + "; ".join(reasons) if reasons else ""


def _topics(recording: RecordingInfo) -> Table:
    missing, unwritten = Counter[str](), Counter[str]()
    for source in recording.sources:
        missing[source.key] += source.missing
        unwritten[source.key] += source.received - source.written
    table = Table()
    for heading in ("topic", "key", "messages", "per second", "missing", "not written"):
        table.add_column(heading, justify="left" if heading in ("topic", "key") else "right")
    for topic in recording.topics:
        counts = (missing[topic.key], unwritten[topic.key])
        table.add_row(
            topic.topic, topic.key, str(topic.messages), f"{topic.rate_hz:.1f}", *(str(count) for count in counts)
        )
    return table
