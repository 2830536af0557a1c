"""What a damaged recording still has."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import mcap.exceptions
from mcap import records
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from fieldpose.bus.mcap_files import DAMAGE, RECORD_LIMIT, Attachment, ExactBytes, Kind, Payload, open_file
from fieldpose.errors import RecordingError

_RECORD_HEAD, _CHUNK_HEAD = 9, 32


@dataclass
class Salvage:
    """What can be read of a damaged recording, up to the damage: `damage` says what that was, None where none."""

    path: Path | str
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    kinds: dict[str, Kind] = field(default_factory=dict)
    damage: str | None = None

    def payloads(self) -> Iterator[Payload]:
        """The messages in the order of the file; metadata and attachments are collected on the way.

        Raises RecordingError where the file cannot be opened or does not begin as a recording.
        """
        channels: dict[int, str] = {}
        try:
            with open_file(self.path) as stream:
                if os.fstat(stream.fileno()).st_size < len(MCAP0_MAGIC):
                    raise mcap.exceptions.InvalidMagic("too short")
                yield from self._read(
                    StreamReader(stream, validate_crcs=True, record_size_limit=RECORD_LIMIT), channels
                )
        except mcap.exceptions.InvalidMagic as error:
            raise RecordingError(f"{self.path}: is no recording (MCAP file)") from error
        except DAMAGE as error:
            self.damage = str(error) or type(error).__name__
        if self.damage is not None:
            # What is whole within the chunk that the file ends in, which the reader gives as a whole or not at all.
            with suppress(*DAMAGE), open_file(self.path) as stream:
                inside = StreamReader(ExactBytes(_cut_chunk(stream)), skip_magic=True, record_size_limit=RECORD_LIMIT)
                yield from self._read(inside, channels)

    def _read(self, reader: StreamReader, channels: dict[int, str]) -> Iterator[Payload]:
        schemas: dict[int, tuple[str, str, bytes]] = {}
        for record in reader.records:
            if isinstance(record, records.Schema):
                schemas[record.id] = (record.name, record.encoding, record.data)
            elif isinstance(record, records.Channel):
                channels[record.id] = record.topic
                # The schema stands before it, but not once more in the chunk that a file ends in.
                if record.schema_id in schemas:
                    self.kinds[record.topic] = Kind(record.message_encoding, schemas[record.schema_id])
            elif isinstance(record, records.Message):
                key, data = channels[record.channel_id], record.data
                yield Payload(key, data, record.log_time, record.publish_time, record.sequence)
            elif isinstance(record, records.Metadata):
                self.metadata.append((record.name, record.metadata))
            elif isinstance(record, records.Attachment):
                self.attachments.append(Attachment(record.name, record.media_type, record.data))


def _cut_chunk(stream: BinaryIO) -> bytes:
    """The records in an uncompressed chunk that goes on beyond the end of the file; none where it ends elsewhere.

    Source: MCAP's specification, of a record: opcode (1 byte), length (8), and of a chunk: two times and a size (8
    each), a checksum (4), the compression's name with its length (4), the length of the records (8).
    """
    size = os.fstat(stream.fileno()).st_size
    at = len(MCAP0_MAGIC)
    while True:
        stream.seek(at)
        opcode, length = struct.unpack("<BQ", stream.read(_RECORD_HEAD))
        if at + _RECORD_HEAD + length > size:
            break
        at += _RECORD_HEAD + length
    if opcode != Opcode.CHUNK:
        return b""
    _, _, _, _, name = struct.unpack("<QQQLL", stream.read(_CHUNK_HEAD))
    stream.read(8)
    return b"" if name else stream.read(min(size - stream.tell(), RECORD_LIMIT))
