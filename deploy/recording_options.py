"""How a recorder writes: in parts, in which form, and what it keeps in memory."""

from __future__ import annotations

import math
import re
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fieldpose.bus.mcap_files import Attachment
from fieldpose.bus.open_recording import check_new, reason, unfinished_file
from fieldpose.bus.recorder import Store
from fieldpose.bus.recording import Metadata
from fieldpose.bus.requests import MOST_SNAPSHOT_S
from fieldpose.bus.ring import SnapshotConfig, Snapshots
from fieldpose.bus.splitting import OpenPart, Split, SplitWriter, native_parts, part_path, parts_of
from fieldpose.bus.tee import Tee
from fieldpose.bus.topics import Address
from fieldpose.errors import RecordingError, UsageError
from fieldpose.stages.nerf.metadata import FieldMetadata

_NUMBER = r"(\d+(?:\.\d+)?)\s*"
_BYTES = {"kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}
_LEAST_PART_BYTES, _LEAST_PART_S = 1e6, 1.0

START = "{start}"
Form = Literal["fieldpose", "foxglove", "both"]


@dataclass(frozen=True)
class RecordingOptions:
    """Options of whatever records."""

    split: str | None = None
    """Begin a new file, FILE-000.mcap, FILE-001.mcap and so on, at a size, after a time, or both, as 1GB,10min."""
    format: Form = "fieldpose"
    """fieldpose: its own messages, which can be replayed; foxglove: Foxglove's schemas, of one pipeline (needs pip
    install 'fieldpose[foxglove]'); both: also FILE-foxglove.mcap."""
    snapshots: Path | None = None
    """Keep what comes in memory, and write the last of it as recordings into this folder: each time that tracking is
    lost, and when `fieldpose record --snapshot 10s` asks for it."""
    ring: str = "30s"
    """How much is kept for snapshots: 30s, or 2min."""
    ring_size: str = "512MB"
    """At most so much memory for that; twice as much while a snapshot is written."""
    when_lost: bool = True
    """Write a snapshot whenever tracking is lost, up to 20 in a run."""

    def check(self, record: Path | None, pipelines: int = 1, attached: int = 0) -> None:
        """Raise UsageError and RecordingError for what could not be recorded so.

        pipelines: how many are recorded, 0 where that is open; attached: bytes that each part holds besides messages.
        """
        self.check_form(record, pipelines)
        self._check_room(attached)
        for path in self.files(record):
            _check_way(path, self.split is not None)
        if self.snapshots is not None:
            _check_folder(self.snapshots)

    def check_form(self, record: Path | None, pipelines: int) -> None:
        """Raise UsageError for options that cannot be, or not with so many pipelines."""
        self.parts()
        self.snapshot_config()
        if record is None and (self.split is not None or self.format != "fieldpose"):
            raise UsageError("split and format are of a recording; give the file to record into")
        if self.format == "fieldpose":
            return
        from fieldpose.deploy.foxglove.extra import check_extra

        check_extra()
        if pipelines != 1:
            raise UsageError(
                f"format {self.format}: Foxglove's schemas hold one pipeline; name it by --object and --camera, or"
                " record fieldpose's own messages, of which `fieldpose export --foxglove` writes any"
            )

    def files(self, record: Path | None) -> list[Path]:
        """The file of each form, which parts are named after."""
        if record is None:
            return []
        return [record, record.with_stem(f"{record.stem}-foxglove")] if self.format == "both" else [record]

    def parts(self) -> Split | None:
        """When a new file is begun. Raises UsageError."""
        if self.split is None:
            return None
        sizes = [one for text in self.split.split(",") if (one := _measured(text, _BYTES)) is not None]
        times = [one for text in self.split.split(",") if (one := _measured(text, _SECONDS)) is not None]
        if len(sizes) + len(times) != len(self.split.split(",")) or len(sizes) > 1 or len(times) > 1:
            raise UsageError(f"split {self.split!r}: expected a size, a time or both, as 1GB, 10min or 1GB,10min")
        if min(sizes, default=_LEAST_PART_BYTES) < _LEAST_PART_BYTES or min(times, default=1.0) < _LEAST_PART_S:
            raise UsageError(f"split {self.split!r}: parts have at least 1 MB and last at least 1 s")
        return Split(round(sizes[0]) if sizes else None, times[0] if times else None)

    def snapshot_config(self) -> SnapshotConfig | None:
        """What is kept for snapshots; None where nothing is. Raises UsageError."""
        if self.snapshots is None:
            return None
        return SnapshotConfig(self.snapshots, seconds_of(self.ring, "ring"), self._ring_bytes(), self.when_lost)

    @property
    def most_memory_mb(self) -> int:
        """What snapshots take at most. Raises UsageError."""
        return 0 if self.snapshots is None else math.ceil(2 * self._ring_bytes() / 1e6)

    def keep(self, metadata: Metadata | None = None, attachments: Iterable[Attachment] = ()) -> Snapshots | None:
        """What keeps the last messages, where that is wanted. Raises UsageError."""
        config = self.snapshot_config()
        return None if config is None else Snapshots(config, metadata, attachments)

    def store(
        self,
        record: Path | None,
        address: Address,
        metadata: Metadata | None = None,
        attachments: Iterable[Attachment] = (),
        field: FieldMetadata | None = None,
        resume: bool = False,
        from_start: bool = False,
    ) -> Callable[[], Store] | None:
        """What opens the files; None where none is recorded. field: of the pipeline, for its true poses in Foxglove."""
        if record is None:
            return None
        attached = list(attachments)
        split = self.parts()
        self._check_room(sum(len(attachment.data) for attachment in attached))
        openers: list[OpenPart] = []
        if self.format != "foxglove":
            openers.append(native_parts(metadata, attached, from_start))
        if self.format != "fieldpose":
            from fieldpose.deploy.foxglove.recording import foxglove_parts

            openers.append(foxglove_parts(address, field, from_start))
        each = list(zip(self.files(record), openers, strict=True))

        def opened() -> Store:
            stores = [_opened(path, opener, split, resume) for path, opener in each]
            return stores[0] if len(stores) == 1 else Tee(stores)

        return opened

    def arguments(self, prefix: str) -> list[str]:
        """These options as a command line gives them, each with `prefix` in its name."""
        words = [f"--{prefix}format", self.format, f"--{prefix}ring", self.ring, f"--{prefix}ring-size", self.ring_size]
        words += [] if self.split is None else [f"--{prefix}split", self.split]
        words += [] if self.snapshots is None else [f"--{prefix}snapshots", str(self.snapshots.absolute())]
        return [*words, f"--{prefix}{'' if self.when_lost else 'no-'}when-lost"]

    def _check_room(self, attached: int) -> None:
        split = self.parts()
        if split is not None and split.max_bytes is not None and 2 * attached > split.max_bytes:
            raise UsageError(
                f"split {self.split!r}: each part also holds {attached / 1e6:.0f} MB of settings and field; make it"
                f" {2 * attached / 1e6 + 1:.0f}MB or more"
            )

    def _ring_bytes(self) -> int:
        found = _measured(self.ring_size, _BYTES)
        if found is None or found < 1e6:
            raise UsageError(f"ring-size {self.ring_size!r}: expected at least 1MB, as 512MB or 2GB")
        return round(found)


def seconds_of(text: str, what: str) -> float:
    """A time of at most 10 minutes in seconds. Raises UsageError."""
    found = _measured(text, _SECONDS)
    if found is None or not 0 < found <= MOST_SNAPSHOT_S:
        raise UsageError(f"{what} {text!r}: expected a time above 0, at most 10min, as 10s or 2min")
    return found


def recorded_files(record: Path, split: bool) -> list[Path]:
    """The finished files of a recording, in their order."""
    if not split:
        return [record] if record.exists() else []
    return [part_path(record, number) for number, whole in parts_of(record).items() if whole]


def with_start(record: Path, at: time.struct_time | None = None) -> Path:
    """The file of a recorder that is started now, for START in its name: each start has a file of its own."""
    return Path(str(record).replace(START, time.strftime("%Y%m%d-%H%M%S", at or time.localtime())))


def unfinished_files(record: Path, split: bool) -> list[Path]:
    """The files of a recording that were begun and not finished."""
    begun = [part_path(record, number) for number in parts_of(record)] if split else [record]
    return [there for path in begun if (there := unfinished_file(path)) is not None]


def _opened(path: Path, opener: OpenPart, split: Split | None, resume: bool) -> Store:
    return opener(path, 0, None, resume) if split is None else SplitWriter(path, split, opener, resume)


def _check_way(path: Path, split: bool) -> None:
    """Raise RecordingError where a recording is in the way, finished or not."""
    if not split:
        check_new(path)
    for there in recorded_files(path, split):
        raise RecordingError(f"{there}: is there already, and no recording replaces a file; give another name")
    for there in unfinished_files(path, split):
        raise RecordingError(
            f"{there}: an unfinished recording is in the way; `fieldpose recover {there}` saves what is in it, or"
            " remove it"
        )


def _check_folder(folder: Path) -> None:
    """Make the folder of snapshots. Raises RecordingError where nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise RecordingError(f"{folder}: no snapshots can be written there: {reason(error)}") from error


def _measured(text: str, units: dict[str, float]) -> float | None:
    found = re.fullmatch(_NUMBER + f"({'|'.join(units)})", text.strip())
    return float(found[1]) * units[found[2]] if found else None
