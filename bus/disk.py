"""The file that a recording is written into: it can be finished where the disk is full, and it replaces no other."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

RESERVE_BYTES = 16 << 20
"""Room that is kept for the chunk in progress and the end of a file: its index has about 300 bytes a chunk of 2 MiB."""
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)


class RecordingFile:
    """A new file under a temporary name, as a writer of MCAP wants it.

    full: why there is no more room, once a write had none; that write has gone where room was kept, and nothing but
    the file's end should follow. broken: a write has failed for good, and what was written is not to be continued.
    Raises OSError where the file is there already, or nothing can be written.
    """

    def __init__(self, partial: Path) -> None:
        self.full: OSError | None = None
        self.broken = False
        self._partial = partial
        self._at = 0
        partial.parent.mkdir(parents=True, exist_ok=True)
        # Nameless, so that a kill leaves none of it.
        self._reserve = tempfile.TemporaryFile(dir=partial.parent)  # noqa: SIM115 - closed by `close`
        try:
            os.posix_fallocate(self._reserve.fileno(), 0, RESERVE_BYTES)
            self._stream = open(partial, "x+b", buffering=0)  # noqa: SIM115 - closed by `close`
        except BaseException:
            self._reserve.close()
            raise
        limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
        self._most = None if limit == resource.RLIM_INFINITY else limit - RESERVE_BYTES

    def write(self, data: bytes | memoryview) -> int:
        """Write all of it."""
        if self.full is None and self._most is not None and self._at + len(data) > self._most:
            self.full = OSError(errno.EFBIG, os.strerror(errno.EFBIG))
        try:
            self._write(data)
        except OSError as error:
            self.broken = error.errno not in _NO_ROOM or self.full is not None
            if self.broken:
                raise
            self.full = error
            self._reserve.close()
            self._again(data)
        self._at += len(data)
        return len(data)

    def tell(self) -> int:
        return self._at

    def flush(self) -> None:
        """Nothing is held back."""

    def check(self) -> None:
        """Raise FileNotFoundError where the file is no longer where it was made."""
        own = os.fstat(self._stream.fileno())
        try:
            there = os.stat(self._partial)
        except (FileNotFoundError, NotADirectoryError):
            there = None
        if there is None or (there.st_dev, there.st_ino) != (own.st_dev, own.st_ino):
            raise FileNotFoundError(errno.ENOENT, "it was removed or moved while it was being written")

    def finish(self, path: Path) -> None:
        """Put it on the disk for good, under its own name, in a folder made anew where that was removed.

        Raises FileExistsError where another file has come there, OSError where it cannot be done; then it stays under
        its temporary name.
        """
        self._reserve.close()
        os.fsync(self._stream.fileno())
        try:
            self.check()
        except FileNotFoundError:
            self._copy(path)
        else:
            _rename_to_new(self._partial, path)
        self._stream.close()

    def close(self) -> None:
        """Leave it as it is, under its temporary name."""
        self._reserve.close()
        self._stream.close()

    def discard(self) -> None:
        """Remove it."""
        self.close()
        self._partial.unlink(missing_ok=True)

    def _write(self, data: bytes | memoryview) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[self._stream.write(rest) :]

    def _again(self, data: bytes | memoryview) -> None:
        try:
            self._stream.truncate(self._at)
            self._stream.seek(self._at)
            self._write(data)
        except OSError:
            self.broken = True
            raise

    def _copy(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "xb") as copy:
            try:
                self._stream.seek(0)
                shutil.copyfileobj(self._stream, copy, 1 << 20)
            except OSError:
                with suppress(OSError):
                    path.unlink()
                raise


def _rename_to_new(old: Path, new: Path) -> None:
    """Rename a file, but never onto another one. Raises FileExistsError."""
    try:
        os.link(old, new)
    except FileExistsError:
        raise
    except OSError:
        # A file system without hard links.
        if new.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
        os.rename(old, new)
    else:
        old.unlink()
