"""A recording in parts, each of them whole: PATH-000.mcap, PATH-001.mcap and so on."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from fieldpose.bus.mcap_files import EXPECTED_RECORD, PART_RECORD, Attachment
from fieldpose.bus.messages import Header
from fieldpose.bus.open_recording import unfinished_file
from fieldpose.bus.recording import Metadata, RecordingWriter
from fieldpose.bus.salvage import Salvage
from fieldpose.bus.topics import Topic
from fieldpose.errors import RecordingError

Expected = Mapping[tuple[str, str], int]


@dataclass(frozen=True)
class Split:
    """When a part ends: once it has so many bytes, or once so much time has passed, whichever is first."""

    max_bytes: int | None = None
    seconds: float | None = None


class Part(Protocol):
    """A file that is being written, as `OpenRecording` has it."""

    path: Path
    messages: int
    size: int

    def take_over(self) -> None: ...

    def write_payload(self, key: str, topic: Topic[Any], payload: bytes, log_time_ns: int) -> None: ...

    def note_dropped(self, key: str, header: Header) -> None: ...

    def note_left_out(self, refused: int, doubted: int) -> None: ...

    def flush_if_due(self) -> float: ...

    def close(self, damage: str | None = None, ended: str | None = None) -> bool: ...

    def end_early(self, error: Exception) -> RecordingError: ...


class OpenPart(Protocol):
    """Opens a part, the first where there is none before; resume: goes on with an unfinished file of its name."""

    def __call__(self, path: Path, number: int, before: Any, resume: bool) -> Part: ...


class SplitWriter:
    """Writes parts one after the other, as a recorder's store; the parts before the last are finished beside it.

    Parts that are there already are in the way, unless `resume` says to go on with the unfinished ones. Raises
    RecordingError where they are, or nothing can be written.
    """

    def __init__(self, path: Path, split: Split, open_part: OpenPart, resume: bool = False) -> None:
        self._path, self._split, self._open = path, split, open_part
        self._finished = 0
        self._lossless = True
        self._closing: list[threading.Thread] = []
        self._failure: OSError | None = None
        self._began_ns: int | None = None
        *self._earlier, self._number = self._begun(resume) or [0]
        self._part = self._open(part_path(path, self._number), self._number, None, resume)

    @property
    def messages(self) -> int:
        """In all parts."""
        return self._finished + self._part.messages

    def take_over(self) -> None:
        self._part.take_over()
        for number in self._earlier:
            try:
                part = self._open(part_path(self._path, number), number, None, True)
                part.take_over()
            except RecordingError as error:
                # What can still be done is to end the last one.
                raise OSError(str(error)) from error
            self._close(part)
            self._check()
            self._finished += part.messages

    def write_payload(self, key: str, topic: Topic[Any], payload: bytes, log_time_ns: int) -> None:
        if self._is_full(log_time_ns):
            self._next()
        if self._began_ns is None:
            self._began_ns = log_time_ns
        self._part.write_payload(key, topic, payload, log_time_ns)

    def note_dropped(self, key: str, header: Header) -> None:
        self._part.note_dropped(key, header)

    def note_left_out(self, refused: int, doubted: int) -> None:
        self._part.note_left_out(refused, doubted)

    def flush_if_due(self) -> float:
        return self._part.flush_if_due()

    def close(self) -> bool:
        self._wait()
        return self._part.close() and self._lossless

    def end_early(self, error: Exception) -> RecordingError:
        for thread in self._closing:
            thread.join()
        return self._part.end_early(error)

    def _is_full(self, now_ns: int) -> bool:
        split, began_ns = self._split, self._began_ns
        if began_ns is None:
            return False
        long = split.seconds is not None and now_ns - began_ns >= split.seconds * 1e9
        return long or (split.max_bytes is not None and self._part.size >= split.max_bytes)

    def _next(self) -> None:
        """Begin the next part before the one before is finished, so that a kill always leaves an unfinished one."""
        self._check()
        before, number = self._part, self._number + 1
        try:
            self._part = self._open(part_path(self._path, number), number, before, False)
        except RecordingError as error:
            # What can still be done is to end the part before.
            raise error.__cause__ if isinstance(error.__cause__, OSError) else OSError(str(error)) from error
        self._number, self._began_ns = number, None
        self._finished += before.messages
        # A disk may take longer for a part than the next one lasts: nothing waits for it.
        thread = threading.Thread(target=self._close, args=(before,), name="finish part")
        self._closing = [*(each for each in self._closing if each.is_alive()), thread]
        thread.start()

    def _close(self, part: Part) -> None:
        try:
            if not part.close():
                self._lossless = False
        except RecordingError as error:
            self._failure = OSError(str(error))
        except Exception as error:
            self._failure = OSError(str(part.end_early(error)))

    def _wait(self) -> None:
        for thread in self._closing:
            thread.join()
        self._check()

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _begun(self, resume: bool) -> list[int]:
        """The numbers of unfinished parts to go on with."""
        there = parts_of(self._path)
        unfinished = sorted(number for number, whole in there.items() if not whole)
        if there and not (resume and unfinished):
            name = part_path(self._path, min(there))
            raise RecordingError(f"{name}: a part of another recording is there already; give another name")
        return unfinished


def native_parts(
    metadata: Metadata | None = None, attachments: Iterable[Attachment] = (), from_start: bool = False
) -> OpenPart:
    """Opens parts of fieldpose's own messages, each with all metadata and attachments."""
    attached = list(attachments)

    def open_part(path: Path, number: int, before: RecordingWriter | None, resume: bool) -> RecordingWriter:
        about: dict[str, Mapping[str, str]] = dict(metadata or {})
        if before is not None:
            about |= _continues(number, before.path, before.expected)
        elif resume:
            about |= {name: values for name, values in _begun_with(path).items() if name in _OF_PARTS}
        expected = _read_expected(about.get(EXPECTED_RECORD, {}))
        return RecordingWriter(path, about, attached, resume, from_start, expected)

    return open_part


def part_path(path: Path, number: int) -> Path:
    """The name of a part of a recording."""
    return path.with_name(f"{path.stem}-{number:03d}{path.suffix}")


def parts_of(path: Path) -> dict[int, bool]:
    """The numbers of the parts of a recording that are there, and of each whether it is finished."""
    named = re.compile(rf"{re.escape(path.stem)}-(\d{{3,}}){re.escape(path.suffix)}(\.partial(?:\.before)?)?")
    found: dict[int, bool] = {}
    for entry in path.parent.iterdir() if path.parent.is_dir() else ():
        match = named.fullmatch(entry.name)
        if match is not None:
            found[int(match[1])] = found.get(int(match[1]), False) or match[2] is None
    return dict(sorted(found.items()))


_OF_PARTS = (PART_RECORD, EXPECTED_RECORD)


def _continues(number: int, before: Path, expected: Expected) -> dict[str, Mapping[str, str]]:
    numbers = {f"{key} {source}": str(number) for (key, source), number in sorted(expected.items())}
    return {PART_RECORD: {"part": str(number), "before": before.name}, EXPECTED_RECORD: numbers}


def _read_expected(values: Mapping[str, str]) -> dict[tuple[str, str], int]:
    split = ((name.partition(" "), number) for name, number in values.items())
    return {(key, source): int(number) for (key, _, source), number in split}


def _begun_with(path: Path) -> dict[str, dict[str, str]]:
    """The metadata at the beginning of an unfinished file; none where there is none, or nothing yet in it."""
    begun = unfinished_file(path)
    if begun is None or begun.stat().st_size == 0:
        return {}
    salvage = Salvage(begun)
    next(salvage.payloads(), None)
    return dict(salvage.metadata)
