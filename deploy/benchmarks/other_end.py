"""The process at the other end of the bus: answers, counts what comes, and tells when it came and what it cost."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import cv2
import msgspec
import numpy as np

from fieldpose.bus.codec import decode
from fieldpose.bus.messages import Frame
from fieldpose.bus.topics import FRAME
from fieldpose.bus.transport import Bus
from fieldpose.deploy.benchmarks.echo import WAITING, answer, number_of, session
from fieldpose.deploy.processes.lifeline import PARENT, die_with_parent
from fieldpose.errors import TransportError

FLOW, FRAMES = "fieldpose/echo/flow", "fieldpose/echo/frames"
_ASK, _TOLD = "fieldpose/echo/ask", "fieldpose/echo/told"
_STILL_S, _ANSWER_S, _END_S = 0.3, 2.0, 5.0
_SERVE = "import sys; from fieldpose.deploy.benchmarks.other_end import serve; serve(sys.argv[1])"


class Received(msgspec.Struct):
    """When what was sent came, in ns since the epoch by its number, and the receiving process's CPU seconds."""

    at_ns: dict[int, int]
    cpu_s: float


@contextlib.contextmanager
def other_process(endpoint: str) -> Iterator[None]:
    """A process of its own that serves; it ends with the context, and with this process however that ends."""
    command = [sys.executable, "-P", "-c", _SERVE, endpoint]
    with subprocess.Popen(command, stdin=subprocess.PIPE, env={**os.environ, PARENT: str(os.getpid())}) as process:
        try:
            yield
        finally:
            assert process.stdin is not None
            process.stdin.close()
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()


def serve(endpoint: str) -> None:
    """Answer and count until the standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started this, who ends it
    die_with_parent()
    with session(endpoint) as bus:
        log = _Log(bus)
        bus.subscribe(_ASK, log.tell, WAITING)
        bus.subscribe(FLOW, lambda key, payload, at_ns: log.came(payload, at_ns), WAITING)
        bus.subscribe(FRAMES, log.frame, WAITING)
        answer(bus, log.came)
        sys.stdin.buffer.read()


class OtherEnd:
    """What the other process has received, for who sends."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self._told, self._answers = bus, threading.Event(), list[Received]()
        bus.subscribe(_TOLD, self._heard, WAITING)

    def received(self, expected: int) -> Received:
        """What came since the last call, once so many have or nothing more does. Raises TransportError."""
        total = self._ask()
        while len(total.at_ns) < expected:
            time.sleep(_STILL_S)
            more = self._ask()
            total = Received(total.at_ns | more.at_ns, total.cpu_s + more.cpu_s)
            if not more.at_ns:
                break
        return total

    def _ask(self) -> Received:
        self._told.clear()
        self._bus.put(_ASK, b"")
        if not self._told.wait(_ANSWER_S):
            raise TransportError("the process at the other end of the bus does not answer")
        return self._answers.pop()

    def _heard(self, key: str, payload: bytes, at_ns: int) -> None:
        self._answers.append(msgspec.json.decode(payload, type=Received))
        self._told.set()


class _Log:
    def __init__(self, bus: Bus) -> None:
        self._bus, self._lock, self._at_ns, self._cpu_s = bus, threading.Lock(), dict[int, int](), time.process_time()

    def came(self, payload: bytes, at_ns: int) -> None:
        self._note(number_of(payload), at_ns)

    def frame(self, key: str, payload: bytes, at_ns: int) -> None:
        """Do what a stage does that needs the pixels."""
        frame = decode(payload, Frame, FRAME.max_bytes)
        if frame.encoding == "jpeg":
            decoded(frame.image)
        self._note(frame.header.frame_id, time.time_ns())

    def tell(self, key: str, payload: bytes, at_ns: int) -> None:
        with self._lock:
            now = time.process_time()
            told = Received(self._at_ns, now - self._cpu_s)
            self._at_ns, self._cpu_s = {}, now
        self._bus.put(_TOLD, msgspec.json.encode(told))

    def _note(self, number: int, at_ns: int) -> None:
        with self._lock:
            self._at_ns[number] = at_ns


def decoded(jpeg: np.ndarray) -> np.ndarray:
    """The pixels (h, w, 3) uint8 RGB of a JPEG file's bytes (n,) uint8. Raises ValueError."""
    bgr = cv2.imdecode(jpeg, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if bgr is None:
        raise ValueError("not a JPEG file")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
