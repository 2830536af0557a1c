"""An MCAP file while it is being written: flushed once a second, finished where it can be, replacing no other."""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from fieldpose.bus.disk import RecordingFile
from fieldpose.bus.logs import describe
from fieldpose.bus.salvage import Salvage
from fieldpose.errors import FieldposeError, RecordingError

_CHUNK_BYTES = 2 << 20
_FLUSH_S = 1.0


def partial_path(path: Path | str) -> Path:
    """Where a recording stands until it is closed."""
    return Path(f"{path}.partial")


def aside_path(path: Path | str) -> Path:
    """Where an unfinished recording stands while what is in it is taken over."""
    return Path(f"{path}.partial.before")


def unfinished_file(path: Path | str) -> Path | None:
    """The file with all there is of a recording that was begun and not finished; None where there is none.

    Beside one that is being taken over, what stands under the temporary name is but a copy of its beginning.
    """
    return next((there for there in (aside_path(path), partial_path(path)) if there.exists()), None)


def check_new(path: Path) -> None:
    """Raise RecordingError where a recording would have to replace a file."""
    if path.exists():
        raise RecordingError(f"{path}: is there already, and no recording replaces a file; give another name")


def set_aside(path: Path, resume: bool) -> Path | None:
    """Put an unfinished recording of a name out of the way, to be gone on from; None where there is none.

    Raises RecordingError where it is finished, or not to be resumed.
    """
    check_new(path)
    partial = partial_path(path)
    aside = aside_path(path)
    # Killed before its first flush, a recording has nothing at all.
    unfinished = partial.exists() and partial.stat().st_size > 0
    if not resume and (unfinished or aside.exists()):
        raise RecordingError(
            f"{unfinished_file(path)}: an unfinished recording is in the way; `fieldpose recover` it, or remove it"
        )
    # A file set aside already is one whose taking over was itself interrupted: it has the older messages.
    if unfinished and not aside.exists():
        os.replace(partial, aside)
    if partial.exists():
        partial.unlink()
    return aside if aside.exists() else None


class OpenRecording(ABC):
    """Writes PATH.partial, which `close` renames to PATH, and a kill leaves with all but the chunk in progress.

    An unfinished recording of its name is in the way, unless `resume` says to go on with it: then `take_over` is to be
    called before anything is written. Raises RecordingError where a file is in the way, or nothing can be written. The
    methods that write raise OSError, after which `end_early` is left to be called.
    """

    def __init__(self, path: Path | str, profile: str, compression: CompressionType, resume: bool = False) -> None:
        self.path = Path(path)
        self.messages = 0
        self.size = 0
        self._partial = partial_path(path)
        self._flushed = time.monotonic()
        self._before = set_aside(self.path, resume)
        try:
            self._file = RecordingFile(self._partial)
        except OSError as error:
            self._put_back()
            raise self._unwritable(error) from error
        stream: Any = self._file
        self._writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=compression)
        try:
            self._writer.start(profile=profile)
        except OSError as error:
            self.discard()
            raise self._unwritable(error) from error

    @abstractmethod
    def close(self, damage: str | None = None, ended: str | None = None) -> bool:
        """Finish the file and give it its name; return whether it is lossless.

        damage: why it cannot be; ended: why nothing came after. Raises RecordingError where another file has come to
        be there, and OSError.
        """

    @abstractmethod
    def copy(self, salvage: Salvage) -> int:
        """Write every message that can be saved of another file; return their number."""

    def take_over(self) -> None:
        """Write what can be saved of the unfinished file that was there, and remove that; as long as copying it takes.

        Raises RecordingError where it cannot be done; then that file is there as it was, and nothing else.
        """
        if self._before is None:
            return
        try:
            self.copy(Salvage(self._before))
            self.flush()
            self._before.unlink()
        except Exception as error:
            why = reason(error).removeprefix(f"{self._before}: ")
            self.discard()
            raise RecordingError(
                f"{self._partial}: the recorder cannot go on with it: {why}; `fieldpose recover` saves what is in it"
            ) from error
        self._before = None

    def end_early(self, error: Exception) -> RecordingError:
        """Finish the file after writing has failed, as far as that can be done; gives what is to be told of it."""
        why = reason(error)
        if not self._file.broken:
            try:
                self.close(ended=why)
            except RecordingError as failure:
                return failure
            except Exception:
                pass  # The first error is the one to be told.
            else:
                return RecordingError(f"{self.path}: the recording ended early: {why}; what came before is in it")
        self._file.close()
        return RecordingError(f"{self._partial}: cannot be written: {why}; `fieldpose recover` saves what is in it")

    def finish(self, damage: str | None = None) -> None:
        """`close`, with nothing left behind where there is no room for it. Raises RecordingError."""
        try:
            self.close(damage)
        except OSError as error:
            self.discard()
            raise RecordingError(f"{self.path}: cannot be written: {error.strerror}; nothing was") from error

    def discard(self) -> None:
        """Give up what was written; an unfinished file that it was to go on with is as it was before."""
        self._file.discard()
        self._put_back()

    def flush_if_due(self) -> float:
        """Flush once a second, to be called also while nothing comes; return the seconds until the next time."""
        if time.monotonic() - self._flushed >= _FLUSH_S:
            self.flush()
        return max(0.0, self._flushed + _FLUSH_S - time.monotonic())

    def flush(self) -> None:
        """Hand what was written to the operating system, so that a kill of this process does not lose it."""
        self._flushed = time.monotonic()
        self._writer.flush()
        self._check_room()
        self._file.check()

    def _add_message(
        self, channel: int, log_time_ns: int, payload: bytes, publish_ns: int, sequence: int
    ) -> None:  # fmt: skip
        self.messages += 1
        self.size += len(payload)
        self._writer.add_message(channel, log_time_ns, payload, publish_ns, sequence % 2**32)
        self._check_room()
        self.flush_if_due()

    def _check_room(self) -> None:
        if self._file.full is not None:
            raise self._file.full

    def _finish(self) -> None:
        self._writer.finish()
        try:
            self._file.finish(self.path)
        except OSError as error:
            self._file.close()
            why = "another file has come there" if isinstance(error, FileExistsError) else error.strerror
            raise RecordingError(
                f"{self.path}: the recording cannot be given its name: {why}; it is whole, as {self._partial}"
            ) from error

    def _put_back(self) -> None:
        if self._before is not None:
            with suppress(OSError):
                os.rename(self._before, self._partial)

    def _unwritable(self, error: OSError) -> RecordingError:
        return RecordingError(f"{self._partial}: cannot be written: {error.strerror}")


def reason(error: Exception) -> str:
    """Why something failed, in a line: what the system says, or what the error is where nobody foresaw it."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return str(error) if isinstance(error, FieldposeError) else describe(error)
