"""Joining the bus of a hub: by which keys, in which role, and why one was not let in."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fieldpose.bus.access import Access, certificate_of, key_of
from fieldpose.bus.transport import WITHOUT_SHARED_MEMORY, ZenohBus, checked_endpoint
from fieldpose.deploy.access.refused import nobody, speaks_tls, why_refused
from fieldpose.deploy.access.roles import role_named, roles
from fieldpose.deploy.access.run_keys import keys_for, keys_of
from fieldpose.deploy.processes.endpoints import host_of, is_local, peer_address, port_of, with_scheme
from fieldpose.errors import TransportError, UsageError

TLS_VARIABLE = "FIELDPOSE_TLS"
"""Environment variable with the folder of certificates, where no option names it."""
_LOOK_S, _LEAST_S, _COMING_S = 0.1, 1.0, 60.0
_OPEN_S = 5.0
"""A hub of one's own may be hanging, or about to come, for so long before who listens is taken for another."""
_FIRST_S, _LONGEST_S = 0.5, 8.0


@dataclass(frozen=True)
class Entry:
    """By what one is let onto the bus. Without any: by the keys of a run of the same user on this machine."""

    tls: Path | None = None
    """The folder of certificates that `fieldpose certs` has made, for several hosts (default: what the environment
    variable FIELDPOSE_TLS names)."""
    open: bool = False
    """Let in, and believe, everybody who reaches the address: no certificates, nothing encrypted."""

    @property
    def folder(self) -> Path | None:
        """The folder of certificates. Raises UsageError where both ways are given."""
        if self.tls is not None and self.open:
            raise UsageError("--tls and --open exclude each other")
        named = os.environ.get(TLS_VARIABLE)
        return self.tls or (Path(named) if named and not self.open else None)


NO_ENTRY = Entry()


@dataclass(frozen=True)
class Joint:
    """How to reach a hub: its address, and one's own part on a closed bus, None on an open one.

    coming: it is of a run of this user's that is up, or about to be.
    """

    hub: str
    access: Access | None = None
    coming: bool = False

    def session(self, listen: str | None = None, shared_memory: bool = True) -> ZenohBus:
        """A session that listens for the others. Raises TransportError."""
        at = listen or peer_address(self.hub)
        at = at if self.access is None else with_scheme(at, "tls")
        return ZenohBus(self.hub, at, None if shared_memory else WITHOUT_SHARED_MEMORY, self.access)

    def wait(self, bus: ZenohBus, timeout_s: float) -> None:
        """Return once the hub answers. Raises TransportError that says why, as soon as that is known."""
        deadline, pause_s = time.monotonic() + timeout_s, _FIRST_S
        while True:
            left_s = deadline - time.monotonic()
            try:
                return bus.wait_for_hub(min(pause_s, max(left_s, 0.0)))
            except TransportError:
                reason = why_refused(self.hub, self.access)
                if reason is not None:
                    raise TransportError(reason) from None
                if left_s <= pause_s:
                    raise TransportError(nobody(self.hub, self.access, round(timeout_s, 1))) from None
            pause_s = min(2 * pause_s, _LONGEST_S)


def joint(hub: str, entry: Entry, names: Sequence[str], timeout_s: float = 0.0) -> Joint:
    """How a process in the first of these roles that there are keys of joins a hub.

    timeout_s: how long a hub of this machine is waited for, which makes the keys. Raises UsageError and TransportError.
    """
    checked_endpoint(hub)
    folder = entry.folder
    if folder is not None:
        return Joint(with_scheme(hub, "tls"), _access(folder, names))
    if entry.open:
        return Joint(_without_tls(hub))
    if not is_local(hub):
        raise UsageError(
            f"{hub} is of another host: give --tls DIR, with certificates of `fieldpose certs` as its hub has them, or"
            " --open where that hub lets everybody in"
        )
    deadline = time.monotonic() + timeout_s
    told_s = time.monotonic() + min(timeout_s, _OPEN_S)
    while (local := keys_of(port_of(hub))) is None:
        if time.monotonic() > told_s and speaks_tls(host_of(hub), port_of(hub)) is False:
            raise TransportError(
                f"{hub} is of no run of yours, and who listens there speaks no TLS: it is an open hub, which may be"
                " anybody's and is joined with --open, or hangs"
            )
        if time.monotonic() > deadline:
            raise TransportError(why_refused(hub, None) or _no_keys(hub, timeout_s))
        time.sleep(_LOOK_S)
    return Joint(with_scheme(hub, "tls"), _access(local, names), coming=True)


def _no_keys(hub: str, waited_s: float) -> str:
    if not hub.startswith("tls/"):
        return nobody(hub, None, waited_s)
    return (
        f"{hub} is closed, and this user has no keys for it: no run of yours on this machine has that port; for another"
        " host's give --tls DIR, as `fieldpose certs` makes it"
    )


def join(hub: str, entry: Entry, names: Sequence[str], timeout_s: float, coming_s: float = _COMING_S) -> ZenohBus:
    """A session in the first of these roles that there are keys of, once its hub answers; see `joint`.

    coming_s: how long one is waited for at least that is known to be coming.
    """
    deadline = time.monotonic() + timeout_s
    way = joint(hub, entry, names, timeout_s)
    if way.coming:
        deadline = max(deadline, time.monotonic() + coming_s)
    bus = way.session()
    try:
        way.wait(bus, max(deadline - time.monotonic(), _LEAST_S))
    except BaseException:
        bus.close()
        raise
    return bus


@contextmanager
def joined(hub: str, entry: Entry, names: Sequence[str], timeout_s: float) -> Iterator[ZenohBus]:
    """The session of `join`, closed in the end."""
    bus = join(hub, entry, names, timeout_s)
    try:
        yield bus
    finally:
        bus.close()


@contextmanager
def hub_keys(listen: str, entry: Entry) -> Iterator[tuple[str, Path | None]]:
    """Gives the address of a hub to be, and the folder of the keys of all who take part; none where it is open.

    They are made, for as long as this lasts, where a hub is for this machine alone. Raises UsageError for a hub that
    others reach without certificates.
    """
    folder = entry.folder
    if folder is not None:
        yield with_scheme(listen, "tls"), folder
    elif entry.open:
        yield _without_tls(listen), None
    else:
        check_kept_out(listen)
        with keys_for(port_of(listen)) as made:
            yield with_scheme(listen, "tls"), made


def check_kept_out(listen: str) -> None:
    """Raise UsageError for an address that other hosts reach, where nobody is kept out."""
    if not is_local(listen):
        raise UsageError(
            f"{listen} can be reached by other hosts, and everybody there could read, and take over, what runs; give"
            " --tls DIR, with certificates of `fieldpose certs DIR`, or --open to have it so"
        )


def _without_tls(address: str) -> str:
    if address.startswith("tls/"):
        raise UsageError(f"{address} is an address of TLS, which --open goes without; write tcp/ instead")
    return address


def access_as(folder: Path, role: str) -> Access:
    """The part of a role on a closed bus. Raises TransportError where its certificate is not there or not valid."""
    return _access(folder, (role,))


def _access(folder: Path, names: Sequence[str]) -> Access:
    from fieldpose.deploy.access.certificates import check_certificate

    those = [name for name in names if _readable(certificate_of(folder, name)) and _readable(key_of(folder, name))]
    if not those:
        wanted = " or ".join(names)
        there = ", ".join(sorted(path.stem for path in folder.glob("*.key"))) or "none"
        raise TransportError(f"{folder}: no certificate and key of the role {wanted}; there are those of: {there}")
    access = Access(folder, role_named(those[0]), roles())
    check_certificate(access.authority)
    check_certificate(access.certificate)
    return access


def _readable(path: Path) -> bool:
    """False where there is none. Raises TransportError for one that may not be read."""
    try:
        path.open("rb").close()
    except FileNotFoundError:
        return False
    except OSError as error:
        whose = f" (this process is of user {os.getuid()})" if isinstance(error, PermissionError) else ""
        raise TransportError(f"{path}: cannot be read{whose}: {error.strerror}") from error
    return True
