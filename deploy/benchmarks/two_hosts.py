"""Two hosts on this machine, network namespaces with a link between them that can be cut; it needs root's rights."""

from __future__ import annotations

import secrets
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from fieldpose.deploy.processes.forking import FIELDPOSE

_END_S = 20.0


@dataclass(frozen=True)
class TwoHosts:
    """The names of both hosts, and their addresses on the link."""

    camera: str
    stages: str
    camera_at: str
    stages_at: str

    def cut(self) -> None:
        """Let nothing pass between them."""
        _ip("-n", self.camera, "link", "set", "veth0", "down")

    def mend(self) -> None:
        """Let everything pass again."""
        _ip("-n", self.camera, "link", "set", "veth0", "up")

    @contextmanager
    def started(self, host: str, *arguments: object) -> Iterator[subprocess.Popen[str]]:
        """`fieldpose` with these arguments on one of them; ended by Ctrl-C, and killed where that does not help."""
        command = ["ip", "netns", "exec", host, *FIELDPOSE, *map(str, arguments)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


@contextmanager
def two_hosts() -> Iterator[TwoHosts]:
    """Two hosts, gone in the end. Raises OSError and CalledProcessError where there is no right to make them."""
    mark = secrets.token_hex(2)
    camera, stages = f"fieldpose-{mark}-a", f"fieldpose-{mark}-b"
    net = f"10.{int(mark[:2], 16)}.{int(mark[2:], 16)}"
    hosts = TwoHosts(camera, stages, f"{net}.1", f"{net}.2")
    with ExitStack() as closing:
        for name in (camera, stages):
            _ip("netns", "add", name)
            closing.callback(_ip, "netns", "del", name)
        _ip("link", "add", "veth0", "netns", camera, "type", "veth", "peer", "name", "veth0", "netns", stages)
        for name, address in ((camera, hosts.camera_at), (stages, hosts.stages_at)):
            _ip("-n", name, "addr", "add", f"{address}/24", "dev", "veth0")
            for device in ("lo", "veth0"):
                _ip("-n", name, "link", "set", device, "up")
        yield hosts


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
