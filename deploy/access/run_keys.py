"""The keys of a run on this machine: made anew for each hub, and found by its port by other commands of the same user.

They lie in a folder that only this user can enter, $XDG_RUNTIME_DIR/fieldpose or else fieldpose-UID among the temporary
files, and are gone when the hub is. Their owner holds a lock on the folder: without it they are those that a killed run
has left, which are not used, and go when the next one begins.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from fieldpose.deploy.access.roles import roles
from fieldpose.errors import OutputError, TransportError

_OWNER, _NEW, _HUB = "owner", "making-", "hub-"
_MADE_S = 60.0
_PRIVATE = 0o700


@dataclass(frozen=True)
class RunKeys:
    """The keys of a hub that runs: its port, their folder, the process that made them."""

    port: int
    folder: Path
    pid: int


@contextmanager
def keys_for(port: int) -> Iterator[Path]:
    """Make keys of all roles for the hub of a port, and remove them in the end; gives their folder.

    Raises TransportError where another run has that port, OutputError where no private folder can be had.
    """
    base = _private(_bases()[0])
    _remove_stale(base)
    folder, made = base / f"{_HUB}{port}", _made(base)
    lock = os.open(made, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            # Seen by others once they are whole.
            made.rename(folder)
        except OSError:
            shutil.rmtree(made, ignore_errors=True)
            raise TransportError(f"port {port} is that of another run of yours; choose another with --listen") from None
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


def keys_of(port: int) -> Path | None:
    """The folder of the keys for the hub of a port, where a run of this user has made them."""
    return next((keys.folder for keys in all_keys() if keys.port == port), None)


def all_keys() -> list[RunKeys]:
    """The keys of all hubs of this user's that run."""
    found = []
    for base in _bases():
        if not _is_private(base):
            continue
        for folder in sorted(base.iterdir()):
            pid = _owner(folder)
            if pid is not None and folder.name.startswith(_HUB):
                found.append(RunKeys(int(folder.name.removeprefix(_HUB)), folder, pid))
    return found


def _made(base: Path) -> Path:
    from fieldpose.deploy.access.certificates import make_certificates

    folder = Path(tempfile.mkdtemp(dir=base, prefix=_NEW))
    make_certificates(folder, [role.name for role in roles()])
    (folder / _OWNER).write_text(str(os.getpid()), encoding="utf-8")
    return folder


def _bases() -> list[Path]:
    """Where keys may be, the first being where they are put."""
    temporary = Path(tempfile.gettempdir()) / f"fieldpose-{os.getuid()}"
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if not runtime or not Path(runtime).is_dir() or not os.access(runtime, os.W_OK):
        return [temporary]
    return [Path(runtime) / "fieldpose", temporary]


def _private(base: Path) -> Path:
    with suppress(FileExistsError):
        try:
            base.mkdir(mode=_PRIVATE)
        except FileExistsError:
            raise
        except OSError as error:
            raise OutputError(f"{base}: no folder for the keys of a run can be made there: {error.strerror}") from error
    if not _is_private(base):
        raise OutputError(f"{base}: is no folder that you alone can enter, as the keys of a run need; remove it")
    return base


def _is_private(base: Path) -> bool:
    """Whether it is a folder of this user's that nobody else can enter; no link, which could be turned elsewhere."""
    try:
        found = base.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and stat.S_IMODE(found.st_mode) == _PRIVATE


def _owner(folder: Path) -> int | None:
    """The process that has made the keys of a folder; None where it is gone."""
    try:
        pid = int((folder / _OWNER).read_text(encoding="utf-8"))
        looking = os.open(folder, os.O_RDONLY)
    except (OSError, ValueError):
        return None
    try:
        fcntl.flock(looking, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return pid
    finally:
        os.close(looking)
    return None


def _remove_stale(base: Path) -> None:
    for folder in base.iterdir():
        with suppress(FileNotFoundError):
            unfinished = folder.name.startswith(_NEW) and time.time() - folder.stat().st_mtime > _MADE_S
            if unfinished or (folder.name.startswith(_HUB) and _owner(folder) is None):
                shutil.rmtree(folder, ignore_errors=True)
