"""Recording what goes over a bus: its threads only put into a queue, one thread writes."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from fieldpose.bus.codec import decode_header
from fieldpose.bus.messages import Header, Message
from fieldpose.bus.node import Output
from fieldpose.bus.protocol import Bus, Closing, Sink
from fieldpose.bus.recording import RecordingWriter, partial_path, recover
from fieldpose.bus.topics import ALL, Address, Topic
from fieldpose.errors import CodecError, RecordingError

__all__ = ["RECORDED", "Recorder", "RecorderHandler", "RecordingWriter", "partial_path", "recover"]

RECORDED: tuple[Topic[Any], ...] = tuple(topic for topic in ALL if topic.recorded)
QUEUE_BYTES = 256 << 20
_CHANNEL_CAPACITY = 64


class _Item(NamedTuple):
    """A message to be written, or the header alone of one for which there was no room."""

    key: str
    topic: Topic
    content: bytes | Header
    received_ns: int


class _ByteQueue:
    """Items in order, with a bound on the sum of their bytes until they are written."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._bytes = 0
        self._items: list[_Item] = []
        self._ended = self._refusing = False
        self._changed = threading.Condition()

    def put(self, item: _Item) -> bool:
        """Queue an item unless there is no room for its bytes."""
        with self._changed:
            if self._refusing:
                return True
            if self._bytes + _size(item) > self._limit:
                return False
            self._items.append(item)
            self._bytes += _size(item)
            self._changed.notify()
            return True

    def take(self, timeout_s: float) -> list[_Item] | None:
        """All that is here, after waiting up to `timeout_s` for some; None once ended and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._ended, timeout_s)
            if self._ended and not self._items:
                return None
            items, self._items = self._items, []
            return items

    def done(self, item: _Item) -> None:
        with self._changed:
            self._bytes -= _size(item)

    def end(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()

    def refuse(self) -> None:
        """Let go of everything, now and from now on."""
        with self._changed:
            self._refusing = True
            self._items.clear()


def _size(item: _Item) -> int:
    return len(item.content) if isinstance(item.content, bytes) else 0


class Recorder:
    """Records `topics` of `address`, whose parts may be "*", into a file until `close`.

    `options` are those of RecordingWriter.
    """

    def __init__(
        self,
        bus: Bus,
        address: Address,
        path: Path | str,
        topics: Iterable[Topic[Any]] = RECORDED,
        queue_bytes: int = QUEUE_BYTES,
        **options: Any,
    ) -> None:
        self.error: RecordingError | None = None
        self._queue = _ByteQueue(queue_bytes)
        # Listening begins first: taking over an unfinished recording can last.
        self._subscriptions: list[Closing] = [
            bus.subscribe(address.key(topic), self._sink(topic), _CHANNEL_CAPACITY) for topic in topics
        ]
        try:
            self.writer = RecordingWriter(path, **options)
        except BaseException:
            self._unsubscribe()
            raise
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()

    def close(self) -> bool:
        """Write what is queued, finish the file, return whether it is lossless.

        Raises RecordingError where writing failed; what was written before is in the unfinished file.
        """
        self._unsubscribe()
        self._queue.end()
        self._thread.join()
        if self.error is not None:
            raise self.error
        try:
            return self.writer.close()
        except OSError as error:
            raise self._failure(error) from error

    def _sink(self, topic: Topic[Any]) -> Sink:
        def sink(key: str, payload: bytes, received_ns: int) -> None:
            if not self._queue.put(_Item(key, topic, payload, received_ns)):
                with suppress(CodecError):
                    self._queue.put(_Item(key, topic, decode_header(payload), received_ns))

        return sink

    def _unsubscribe(self) -> None:
        for subscription in self._subscriptions:
            subscription.close()

    def _write(self) -> None:
        try:
            while (items := self._queue.take(self.writer.flush_if_due())) is not None:
                for item in items:
                    self._write_item(item)
                    self._queue.done(item)
        except OSError as error:
            self.error = self._failure(error)
            self._queue.refuse()

    def _write_item(self, item: _Item) -> None:
        if isinstance(item.content, Header):
            self.writer.note_dropped(item.key, item.content)
        else:
            self.writer.write_payload(item.key, item.topic, item.content, item.received_ns)

    def _failure(self, error: OSError) -> RecordingError:
        partial = partial_path(self.writer.path)
        return RecordingError(
            f"{partial}: cannot be written: {error.strerror}; `fieldpose recover` saves what is in it"
        )


class RecorderHandler:
    """A recorder as a process of its own; it listens from when it is made and finishes the file when stopped."""

    name = "recorder"
    inputs: tuple[Topic[Any], ...] = ()
    outputs: tuple[Topic[Any], ...] = ()

    def __init__(self, bus: Bus, address: Address, path: Path | str, **options: Any) -> None:
        self._recorder = Recorder(bus, address, path, **options)

    def start(self) -> None:
        """Nothing to load."""

    def handle(self, topic: Topic[Any], message: Message) -> Iterable[Output]:
        return ()

    def tick(self, now_ns: int) -> Iterable[Output]:
        if self._recorder.error is not None:
            raise self._recorder.error
        return ()

    def stop(self) -> None:
        self._recorder.close()
