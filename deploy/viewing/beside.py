"""The page of a pipeline that is about to run, in a process of its own, so that it is in nobody's way."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

from fieldpose.deploy.access.joining import Entry
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.processes.endpoints import free_port, with_scheme
from fieldpose.deploy.processes.forking import FIELDPOSE
from fieldpose.deploy.processes.sessions import end
from fieldpose.errors import UsageError

_END_S = 10.0


@contextmanager
def page_beside(plans: tuple[Plan, ...], listen: str | None, wanted: bool, entry: Entry) -> Iterator[str | None]:
    """Gives the hub's address that the pipeline is to have; its page is served until the end, where it is wanted.

    UsageError where there are several pipelines, of which a page shows one.
    """
    if not wanted:
        yield listen
        return
    if len(plans) > 1 or plans[0].field is None:
        raise UsageError(
            "--view shows one pipeline; run it without, and then `fieldpose view FIELD --connect HUB` for each"
        )
    plan, hub = plans[0], listen or f"tcp/127.0.0.1:{free_port()}"
    address = plan.settings.address
    parts = ("--site", address.site, "--object", address.object, "--camera", address.camera)
    # Where all addresses are listened at, this machine's own is one.
    reached = hub.replace("0.0.0.0", "127.0.0.1")
    if entry.open:
        entering = ["--open"]
    else:
        # By TLS it waits for the keys, which the run makes.
        reached, entering = with_scheme(reached, "tls"), [] if entry.tls is None else ["--tls", str(entry.tls)]
    viewer = subprocess.Popen([*FIELDPOSE, "view", str(plan.field), "--connect", reached, *entering, *parts])
    try:
        yield hub
    finally:
        end(viewer, _END_S)
