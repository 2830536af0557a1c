"""MCAP files as they lie on a disk: opened so that a cut or damaged one is an error, and the names of our records."""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import mcap.exceptions
from mcap.reader import SeekingReader
from mcap.stream_reader import CRCValidationError

from fieldpose.errors import RecordingError

SOURCE_RECORD = "fieldpose.source"
RECORDING_RECORD = "fieldpose.recording"
SNAPSHOT_RECORD = "fieldpose.snapshot"
PART_RECORD = "fieldpose.part"
EXPECTED_RECORD = "fieldpose.expected"
"""Of a part that is not the first: "KEY SENDER" -> the number that this sender's next message should have."""
RECORD_LIMIT = 1 << 30
DAMAGE = (
    mcap.exceptions.McapError, CRCValidationError, struct.error, EOFError, ValueError, KeyError, IndexError,
    OverflowError, MemoryError, StopIteration, RuntimeError,
)  # fmt: skip


class Payload(NamedTuple):
    """A message as it stands in the file, not yet checked."""

    key: str
    data: bytes
    log_time_ns: int
    publish_ns: int = 0
    sequence: int = 0


class Kind(NamedTuple):
    """How a topic's messages are encoded, and the name, encoding and bytes of their schema."""

    encoding: str
    schema: tuple[str, str, bytes]


class Attachment(NamedTuple):
    name: str
    media_type: str
    data: bytes


class ExactBytes(io.BytesIO):
    """Refuses to read past the end."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            raise EOFError("the file ends within a record")
        return data


class _ExactReader(io.BufferedReader):
    """Refuses to read past the end, where a plain file gives less than was asked for."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            return super().read(size)
        # A damaged length is refused before memory is taken for it.
        if size > io.DEFAULT_BUFFER_SIZE and size > os.fstat(self.fileno()).st_size - self.tell():
            raise EOFError("the file ends within a record")
        data = super().read(size)
        if len(data) < size:
            raise EOFError("the file ends within a record")
        return data


def open_file(path: Path | str) -> _ExactReader:
    try:
        return _ExactReader(io.FileIO(path))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


@contextmanager
def reader_of(path: Path | str) -> Iterator[SeekingReader]:
    with open_file(path) as stream:
        try:
            yield SeekingReader(stream, validate_crcs=True, record_size_limit=RECORD_LIMIT)
        except mcap.exceptions.InvalidMagic as error:
            raise RecordingError(f"{path}: is no recording (MCAP file)") from error
        except (*DAMAGE, OSError) as error:
            detail = " ".join(str(error).split()) or type(error).__name__
            hint = "`fieldpose recover` saves what is in it"
            raise RecordingError(f"{path}: is not a whole recording ({detail}); {hint}") from error
