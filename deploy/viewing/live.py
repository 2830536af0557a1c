"""What a running pipeline says, passed on to a page; images are asked for only while somebody looks."""

from __future__ import annotations

import time
from collections import deque
from functools import partial
from typing import Any

from fieldpose.bus.codec import decode_header
from fieldpose.bus.messages import Header, State
from fieldpose.bus.ports import Inbox
from fieldpose.bus.protocol import Bus
from fieldpose.bus.topics import CAMERA_INFO, CORRESPONDENCES, FOLLOWED, FRAME, GUESS, STATE, STATS, Address, Topic
from fieldpose.deploy.viewing.history import BY_HEADER, IN_FULL, History
from fieldpose.deploy.viewing.moments import WATCHED, Moments
from fieldpose.deploy.viewing.page import Page
from fieldpose.errors import CodecError

_READ = (CAMERA_INFO, STATE, FOLLOWED, CORRESPONDENCES, STATS)
_TIMED = tuple(topic for topic in BY_HEADER if topic not in (FRAME, *_READ))
_QUEUED, _IMAGES = 512, 8
_KEPT_S = 300
_RATE_S, _SILENT_S, _PLOT_S = 3.0, 3.0, 1.0


class Live:
    """Puts together what is said of frames at an address, and shows the newest; `update` is to be called often."""

    def __init__(self, bus: Bus, address: Address, page: Page) -> None:
        self._bus, self._address, self._page = bus, address, page
        self._moments, self._history = Moments(), History(_KEPT_S)
        self._inbox = Inbox(bus, address, _READ, dict.fromkeys(_READ, _QUEUED))
        self._headers: deque[tuple[int, Topic[Any], Header]] = deque(maxlen=_QUEUED)
        self._timed = [bus.subscribe(address.key(topic), partial(self._heard, topic), _QUEUED) for topic in _TIMED]
        self._images: Inbox | None = None
        self._came: deque[float] = deque(maxlen=_QUEUED)
        self._shown: tuple[int, int] | None = None
        self._plotted_at = 0.0

    def close(self) -> None:
        """Listen no more."""
        for listening in (self._inbox, self._images, *self._timed):
            if listening is not None:
                listening.close()

    def update(self) -> None:
        """Take in what has come, and show it where somebody looks."""
        self._look_at_images(self._page.watched)
        self._take_in()
        if not self._page.watched:
            return
        now, newest = time.monotonic(), self._moments.newest()
        new_second = now - self._plotted_at >= _PLOT_S
        if new_second:
            self._plotted_at = now
            self._page.plot(self._history)
            self._page.look_for_recorder()
        if newest is None:
            if new_second:
                self._page.say(self._waiting())
            return
        rate_hz = sum(at > now - _RATE_S for at in self._came) / _RATE_S
        key = newest.frame_id, newest.capture_ns
        if key != self._shown or self._page.asked_otherwise():
            self._shown = key
            self._page.show(newest, self._moments.way, rate_hz)
        elif new_second:
            silent_s = now - self._came[-1]
            self._page.tell(newest, rate_hz, silent_s if silent_s > _SILENT_S else None)

    def _look_at_images(self, wanted: bool) -> None:
        if wanted and self._images is None:
            self._images = Inbox(self._bus, self._address, (FRAME,), {FRAME: _IMAGES})
        elif not wanted and self._images is not None:
            self._images.close()
            self._images = None

    def _take_in(self) -> None:
        received = [*self._inbox.drain(), *(self._images.drain() if self._images is not None else ())]
        headers = [self._headers.popleft() for _ in range(len(self._headers))]
        headers += [(r.received_ns, r.topic, r.message.header) for r in received if r.topic in BY_HEADER]
        for received_ns, topic, header in sorted(headers, key=lambda item: item[0]):
            self._history.note_header(topic, header, received_ns)
        for each in sorted(received, key=lambda r: r.received_ns):
            if each.topic in WATCHED:
                self._moments.note(each.message)
            if each.topic in IN_FULL:
                self._history.note(each.message, each.received_ns)
            if isinstance(each.message, State):
                self._came.append(time.monotonic())
        for _, topic, header in headers:
            if topic is GUESS:
                self._moments.note_solving(header)

    def _heard(self, topic: Topic[Any], key: str, payload: bytes, received_ns: int) -> None:
        """Called from threads of the bus."""
        try:
            header = decode_header(payload)
        except CodecError:
            return  # the stages refuse and count it
        self._headers.append((received_ns, topic, header))

    def _waiting(self) -> str:
        """What is missing, in words."""
        tokens = self._bus.live(Address(self._address.site, "*", "*").live("tracking"))
        running = sorted("/".join(token.split("/")[2:4]) for token in tokens)
        if self._address.pair in running:
            return f"{self._address.pair} is running; waiting for a frame"
        others = f"; running here: {', '.join(running)}" if running else "; nothing is running here yet"
        return f"waiting for {self._address.pair}{others}"
