"""Writing MCAP files whose messages are another program's, of schemas that it knows."""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from fieldpose.bus.mcap_files import RECORDING_RECORD
from fieldpose.bus.open_recording import OpenRecording
from fieldpose.bus.salvage import Salvage
from fieldpose.errors import OutputError

_OWN_PROFILE = "fieldpose"


class _Channels:
    """Topics by name, in a file that is written by `_writer`."""

    _writer: Writer

    def __init__(self) -> None:
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def channel(self, topic: str, encoding: str, schema: tuple[str, str, bytes]) -> None:
        """Announce a topic, how its messages are encoded, and the name, encoding and bytes of their schema."""
        name, schema_encoding, data = schema
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, schema_encoding, data)
        self._channels[topic] = self._writer.register_channel(topic, encoding, self._schemas[name])

    def add(self, name: str, values: Mapping[str, str]) -> None:
        """Put in metadata."""
        self._writer.add_metadata(name, dict(values))


class ForeignRecording(_Channels, OpenRecording):
    """Writes such a file while it is recorded, so that a kill or a full disk leaves what came before."""

    def __init__(self, path: Path, resume: bool = False) -> None:
        _Channels.__init__(self)
        OpenRecording.__init__(self, path, "", CompressionType.ZSTD, resume)

    def write(self, topic: str, payload: bytes, log_ns: int, publish_ns: int, sequence: int) -> None:
        """Write an encoded message of a topic that was announced; times are nanoseconds since the epoch."""
        self._add_message(self._channels[topic], log_ns, payload, publish_ns, sequence)

    def copy(self, salvage: Salvage) -> int:
        """Write every message that can be saved of another file, announcing its topics; return their number."""
        before = self.messages
        for payload in salvage.payloads():
            if payload.key not in self._channels and payload.key in salvage.kinds:
                self.channel(payload.key, *salvage.kinds[payload.key])
            if payload.key in self._channels:
                self.write(payload.key, payload.data, payload.log_time_ns, payload.publish_ns, payload.sequence)
        return self.messages - before

    def close(self, damage: str | None = None, ended: str | None = None) -> bool:
        noted = {name: why for name, why in {"damage": damage, "ended": ended}.items() if why}
        if noted:
            self.add(RECORDING_RECORD, {"lossless": "false", **noted})
        self._finish()
        return not noted


class ForeignWriter(_Channels):
    """Writes PATH under a temporary name and gives it its own at the end; nothing is left where that was not reached.

    Use it in a `with` statement. Raises OutputError where nothing can be written, and where PATH is a recording of this
    project, since that is not made anew as easily as what is written here.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        self._partial = path.with_name(f"{path.stem}.partial{path.suffix}")

    def write(self, topic: str, payload: bytes, log_ns: int, publish_ns: int, sequence: int) -> None:
        """Write an encoded message of a topic that was announced; times are nanoseconds since the epoch."""
        self._writer.add_message(self._channels[topic], log_ns, payload, publish_ns, sequence % 2**32)

    def __enter__(self) -> ForeignWriter:
        if _is_recording(self._path):
            raise OutputError(f"{self._path}: is a recording, which would be overwritten; name another file")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = open(self._partial, "wb")
        except OSError as error:
            raise self._failure(error) from error
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
        self._writer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._writer.finish()
            self._stream.close()
            if error is None:
                os.replace(self._partial, self._path)
        except OSError as failure:
            raise self._failure(failure) from failure
        finally:
            self._stream.close()
            with suppress(OSError):
                self._partial.unlink()
        if isinstance(error, OSError):
            raise self._failure(error) from error

    def _failure(self, error: OSError) -> OutputError:
        return OutputError(f"{self._path}: cannot be written: {error.strerror}")


def _is_recording(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return make_reader(stream).get_header().profile == _OWN_PROFILE
    except (OSError, ValueError, EOFError, struct.error, McapError):
        return False
