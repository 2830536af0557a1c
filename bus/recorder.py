"""Recording what goes over a bus: its threads only put into a queue, one thread writes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, Protocol, TypeVar

from fieldpose.bus.codec import decode_header, encode
from fieldpose.bus.messages import Header, Message
from fieldpose.bus.node import Output
from fieldpose.bus.open_recording import reason
from fieldpose.bus.protocol import Bus, Closing, Sink
from fieldpose.bus.requests import SaveSnapshot, decode_request
from fieldpose.bus.ring import Snapshots
from fieldpose.bus.senders import Senders
from fieldpose.bus.topics import ALL, Address, Topic
from fieldpose.errors import CodecError, RecordingError, RefusedError

NAME = "recorder"
"""Under which it is asked for snapshots."""

T = TypeVar("T")

RECORDED: tuple[Topic[Any], ...] = tuple(topic for topic in ALL if topic.recorded)
QUEUE_BYTES = 512 << 20
"""Five seconds of raw frames and views at full rate, for when a disk stalls."""
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

    @property
    def refusing(self) -> bool:
        return self._refusing

    def refuse(self) -> None:
        """Let go of everything, now and from now on."""
        with self._changed:
            self._refusing = True
            self._items.clear()


def _size(item: _Item) -> int:
    return len(item.content) if isinstance(item.content, bytes) else 0


class Store(Protocol):
    """Where a recorder writes; all methods are called from one thread, and those that write raise OSError."""

    @property
    def messages(self) -> int:
        """How many have been written."""

    def take_over(self) -> None:
        """Go on with what an earlier recorder left unfinished, before anything is written; may last.

        Raises RecordingError where that cannot be done; then it is left as it was, and the store has ended.
        """

    def write_payload(self, key: str, topic: Topic[Any], payload: bytes, log_time_ns: int) -> None:
        """Write bytes from the wire; those that are no message are counted."""

    def note_dropped(self, key: str, header: Header) -> None:
        """Count a message that was received and for which there was no room in the queue."""

    def note_left_out(self, refused: int, doubted: int) -> None:
        """Count what was no message, and what was by nobody who is believed."""

    def flush_if_due(self) -> float:
        """Hand over what was written lately; return the seconds until the next time."""

    def close(self) -> bool:
        """Finish; return whether nothing was lost. Raises RecordingError and OSError."""

    def end_early(self, error: Exception) -> RecordingError:
        """Finish as well as can be after a failure; what is to be told of it."""


class Recorder:
    """Records `topics` of `address`, whose parts may be "*", until `close`: into a store, a ring of snapshots, or both.

    open_store: opens the store, once it listens. It answers requests for snapshots at the key of "recorder" there. What
    is by nobody whom Senders believe is counted and left out.
    """

    def __init__(
        self,
        bus: Bus,
        address: Address,
        open_store: Callable[[], Store] | None,
        snapshots: Snapshots | None = None,
        topics: Iterable[Topic[Any]] = RECORDED,
        queue_bytes: int = QUEUE_BYTES,
    ) -> None:
        self.error: RecordingError | None = None
        self.snapshots = snapshots
        self._queue = _ByteQueue(queue_bytes)
        self._senders = Senders(bus, address.site)
        self._refused = self._doubted = 0
        self._listening: list[Closing] = [
            bus.subscribe(address.key(topic), self._sink(topic), _CHANNEL_CAPACITY) for topic in topics
        ]
        try:
            self._store = open_store() if open_store is not None else None
        except BaseException:
            self._end_listening()
            raise
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()
        self._listening.append(bus.serve(address.control(NAME), self._answer))

    @property
    def messages(self) -> int:
        """How many have been written."""
        return self._store.messages if self._store is not None else 0

    @property
    def ended(self) -> bool:
        """Whether it has given up, so that nothing that comes is written or kept any more."""
        return self._queue.refusing

    def close(self) -> bool:
        """Write what is queued, finish the file, return whether it is lossless.

        Raises RecordingError where writing failed, which says where what was written before is, or a snapshot did.
        """
        self._end_listening()
        self._queue.end()
        self._thread.join()
        told = [] if self.error is None else [str(self.error)]
        lossless = True
        if self._store is not None and self.error is None:
            self._store.note_left_out(self._refused, self._doubted)
            try:
                lossless = self._store.close()
            except RecordingError as error:
                told.append(str(error))
            except Exception as error:
                told.append(str(self._store.end_early(error)))
        if self.snapshots is not None:
            self.snapshots.close()
            told += self.snapshots.failures
        if told:
            raise RecordingError("; ".join(told))
        return lossless

    def _sink(self, topic: Topic[Any]) -> Sink:
        def sink(key: str, payload: bytes, received_ns: int) -> None:
            try:
                header = decode_header(payload)
            except CodecError:
                header = None
            if header is None or len(payload) > topic.max_bytes:
                self._refused += 1
            elif self._senders.doubt(topic, key, header) is not None:
                self._doubted += 1
            elif not self._queue.put(_Item(key, topic, payload, received_ns)):
                self._queue.put(_Item(key, topic, header, received_ns))

        return sink

    def _answer(self, payload: bytes) -> bytes:
        """Called from threads of the bus."""
        request = decode_request(payload)
        if not isinstance(request, SaveSnapshot):
            raise RefusedError(f"{request.kind}: the recorder takes no such request")
        if self.snapshots is None:
            raise RefusedError(
                "save_snapshot: this recorder keeps nothing in memory to be saved; start it with a folder for snapshots"
            )
        return encode(self.snapshots.save(request.seconds))

    def _end_listening(self) -> None:
        for listening in self._listening:
            listening.close()
        self._senders.close()

    def _write(self) -> None:
        try:
            # Here, not where it is opened: copying gigabytes must keep nobody from listening, nor a main loop waiting.
            self._guarded(lambda store: store.take_over(), None)
            while (items := self._queue.take(self._flush())) is not None:
                for item in items:
                    self._write_item(item)
                    self._queue.done(item)
        except Exception as error:
            self._give_up(error)
            self._queue.refuse()

    def _flush(self) -> float:
        """The seconds until this is to be called again."""
        return self._guarded(lambda store: store.flush_if_due(), 1.0)

    def _write_item(self, item: _Item) -> None:
        key, topic, content, received_ns = item
        if isinstance(content, Header):
            self._guarded(lambda store: store.note_dropped(key, content), None)
            return
        if self.snapshots is not None:
            self.snapshots.add(key, topic, content, received_ns)
        self._guarded(lambda store: store.write_payload(key, topic, content, received_ns), None)

    def _guarded(self, work: Callable[[Store], T], otherwise: T) -> T:
        """Do something with the store, unless it has ended; where that fails it ends, and snapshots go on."""
        if self._store is None or self.error is not None:
            return otherwise
        try:
            return work(self._store)
        except Exception as error:
            self._give_up(error)
            if self.snapshots is None:
                self._queue.refuse()
            return otherwise

    def _give_up(self, error: Exception) -> None:
        if self.error is not None:
            return
        if isinstance(error, RecordingError):
            self.error = error
        elif self._store is not None:
            self.error = self._store.end_early(error)
        else:
            self.error = RecordingError(f"no snapshots are kept any more: {reason(error)}")


class RecorderHandler:
    """A recorder as a process of its own; it listens from when it is made and finishes the file when stopped.

    Where nothing can be written any more, that is said once, and the process stays: nobody is to wait for it.
    """

    name = NAME
    inputs: tuple[Topic[Any], ...] = ()
    outputs: tuple[Topic[Any], ...] = ()

    def __init__(
        self,
        bus: Bus,
        address: Address,
        open_store: Callable[[], Store] | None,
        snapshots: Snapshots | None = None,
    ) -> None:
        self._recorder = Recorder(bus, address, open_store, snapshots)
        self._said = False

    def start(self) -> None:
        """Nothing to load."""

    def handle(self, topic: Topic[Any], message: Message) -> Iterable[Output]:
        return ()

    def tick(self, now_ns: int) -> Iterable[Output]:
        if self._recorder.error is not None and not self._said:
            self._said = True
            raise self._recorder.error
        return ()

    def stop(self) -> None:
        self._recorder.close()
