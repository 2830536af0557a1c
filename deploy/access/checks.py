"""What `fieldpose doctor` says of strangers: who of ours listens where, and whether one would be kept out."""

from __future__ import annotations

import ipaddress
import os
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil

from fieldpose.bus.access import Access
from fieldpose.bus.topics import GUESS, Address
from fieldpose.bus.transport import ZenohBus, serve_hub
from fieldpose.deploy.access.joining import access_as
from fieldpose.deploy.access.refused import speaks_tls
from fieldpose.deploy.access.roles import VIEWER, roles
from fieldpose.deploy.checks import Finding
from fieldpose.deploy.graph import HUB
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.errors import FieldposeError

_NAME = "fieldpose"
_MEET_S = 10.0
_STRANGER_S = 1.0
_PROBED = 64


def listening() -> Iterator[Finding]:
    """Where this user's processes of fieldpose listen, and whether each address is closed."""
    found: dict[tuple[str, bool], list[str]] = {}
    those = _listeners()[:_PROBED]
    with ThreadPoolExecutor(len(those) or 1) as probing:
        answers = probing.map(lambda one: bool(speaks_tls(_reached(one[0]), one[1])), those)
        for (host, port, name), answer in zip(those, answers, strict=True):
            found.setdefault((host, answer), []).append(f"{name} {port}")
    if not found:
        yield Finding("listening", "ok", "no process of yours; a run listens on 127.0.0.1 alone, and is closed")
    for (host, is_closed), named in sorted(found.items()):
        detail = f"{host}: {', '.join(sorted(named))}; {'closed by certificates' if is_closed else 'open'}"
        here = ipaddress.ip_address(host).is_loopback
        if is_closed:
            yield Finding("listening", "ok", detail)
        elif here:
            yield Finding("listening", "note", detail, "every user of this machine is let in; leave --open out")
        else:
            yield Finding("listening", "warning", detail, "every host that reaches it is let in; see `fieldpose certs`")


def closed() -> Iterator[Finding]:
    """Whether a bus like that of a run lets in who has keys, and nobody else: tried out."""
    from fieldpose.deploy.access.certificates import make_certificates

    try:
        with tempfile.TemporaryDirectory(prefix="fieldpose-") as folder:
            make_certificates(Path(folder), [HUB, VIEWER])
            let_in, stranger = _tried(Path(folder))
    except FieldposeError as error:
        yield Finding("strangers", "failed", str(error), "nobody can be let in by certificates; is the clock right?")
        return
    if let_in and not stranger:
        yield Finding("strangers", "ok", f"kept out, by certificates of {len(roles())} roles; see docs/security.md")
    else:
        yield Finding("strangers", "failed", "are let in", "use no network that you do not trust, and report this")


def _tried(folder: Path) -> tuple[bool, bool]:
    """Whether a viewer is let in, and a stranger."""
    hub, stop = f"tls/127.0.0.1:{free_port()}", threading.Event()
    serving = threading.Thread(
        target=serve_hub, args=(hub, None, stop), kwargs={"access": access_as(folder, HUB)}, daemon=True
    )
    serving.start()
    try:
        let_in = _joins(hub, "tls/127.0.0.1:0", access_as(folder, VIEWER), _MEET_S)
        return let_in, _joins(hub.replace("tls/", "tcp/"), "tcp/127.0.0.1:0", None, _STRANGER_S)
    finally:
        stop.set()
        serving.join()


def _joins(hub: str, listen: str, access: Access | None, timeout_s: float) -> bool:
    bus = ZenohBus(hub, listen, access=access)
    try:
        bus.subscribe(Address().key(GUESS), lambda key, payload, at_ns: None, 1)
        bus.wait_for_hub(timeout_s)
    except FieldposeError:
        return False
    finally:
        bus.close()
    return True


def _listeners() -> list[tuple[str, int, str]]:
    """Host, port and name of each process of ours that listens."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.uids().real != os.getuid() or process.pid == os.getpid():
                continue
            words = " ".join(process.cmdline()).split()
            name = _name(words)
            if name is not None:
                found += [(c.laddr.ip, c.laddr.port, name) for c in process.net_connections("tcp") if _listens(c)]
        except psutil.Error:
            continue
    return sorted(set(found))


def _listens(connection: object) -> bool:
    return getattr(connection, "status", "") == psutil.CONN_LISTEN


def _name(words: list[str]) -> str | None:
    """What a process of ours is, by its command line: `fieldpose stage NAME …` or `python -m fieldpose COMMAND …`."""
    places = [place for place, word in enumerate(words[:4]) if Path(word).name == _NAME]
    if not places or places[-1] + 1 >= len(words):
        return None
    rest = words[places[-1] + 1 :]
    return rest[1] if rest[0] == "stage" and len(rest) > 1 else rest[0]


def _reached(host: str) -> str:
    """Where an address that listens on all interfaces is reached from here."""
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
