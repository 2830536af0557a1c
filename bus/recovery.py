"""Saving what is in an unfinished or damaged recording."""

from __future__ import annotations

from pathlib import Path

from fieldpose.bus.foreign import ForeignRecording
from fieldpose.bus.mcap_files import RECORDING_RECORD, SOURCE_RECORD
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.salvage import Salvage
from fieldpose.bus.topics import topic_of
from fieldpose.errors import RecordingError

_AT_THE_END = (SOURCE_RECORD, RECORDING_RECORD)


def recover(path: Path | str, out: Path | str) -> int:
    """Write what can be saved of a recording, or of one in another program's schemas, as a whole one.

    Returns the number of messages. Raises RecordingError where `path` does not begin as a recording, holds no message,
    or nothing can be written.
    """
    first = next(Salvage(path).payloads(), None)
    ours = first is None or topic_of(first.key) is not None
    salvage, writer = Salvage(path), RecordingWriter(out) if ours else ForeignRecording(Path(out))
    try:
        saved = writer.copy(salvage)
        if saved == 0:
            why = "" if salvage.damage is None else f" ({salvage.damage})"
            raise RecordingError(f"{path}: no whole message is in it{why}; nothing was written")
        for name, values in salvage.metadata:
            if name not in _AT_THE_END:
                writer.add(name, values) if isinstance(writer, ForeignRecording) else writer.add({name: values})
        if isinstance(writer, RecordingWriter):
            writer.add(attachments=salvage.attachments)
    except RecordingError:
        writer.discard()
        raise
    except OSError as error:
        writer.discard()
        raise RecordingError(f"{out}: cannot be written: {error.strerror}; nothing was") from error
    writer.finish(damage=salvage.damage)
    return saved
