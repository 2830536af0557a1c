"""What came last, kept in memory, and written as a recording when that is asked for or tracking is lost."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from fieldpose.bus.codec import decode
from fieldpose.bus.logs import stage_logger
from fieldpose.bus.mcap_files import SNAPSHOT_RECORD, Attachment
from fieldpose.bus.messages import TrackingState
from fieldpose.bus.open_recording import reason, unfinished_file
from fieldpose.bus.recording import Metadata, RecordingWriter
from fieldpose.bus.requests import SnapshotSaved
from fieldpose.bus.topics import STATE, Topic
from fieldpose.errors import CodecError, RecordingError, RefusedError


class _Kept(NamedTuple):
    key: str
    topic: Topic[Any]
    payload: bytes
    received_ns: int


class Ring:
    """The messages of the last `seconds`, and no more than `max_bytes` of them; may be used from several threads."""

    def __init__(self, seconds: float, max_bytes: int) -> None:
        self._kept_ns, self._max_bytes = round(seconds * 1e9), max_bytes
        self._items: deque[_Kept] = deque()
        self._bytes = 0
        self._lock = threading.Lock()

    def add(self, key: str, topic: Topic[Any], payload: bytes, received_ns: int) -> None:
        """Keep a message, in place of the oldest."""
        with self._lock:
            self._items.append(_Kept(key, topic, payload, received_ns))
            self._bytes += len(payload)
            while self._bytes > self._max_bytes or self._items[0].received_ns < received_ns - self._kept_ns:
                self._bytes -= len(self._items.popleft().payload)
                if not self._items:
                    break

    def last(self, seconds: float) -> list[_Kept]:
        """What came within so many seconds before the newest."""
        with self._lock:
            items = list(self._items)
        since = items[-1].received_ns - round(seconds * 1e9) if items else 0
        return [item for item in items if item.received_ns >= since]


@dataclass(frozen=True)
class SnapshotConfig:
    """folder: where snapshots are written. seconds, max_bytes: what is kept in memory, whichever is less.

    when_lost: whether one is written each time that tracking is lost, most_lost times at most.
    """

    folder: Path
    seconds: float = 30.0
    max_bytes: int = 512 << 20
    when_lost: bool = True
    most_lost: int = 20


class Snapshots:
    """Keeps what came last, and writes it as recordings of their own, with this metadata and these attachments.

    saved: those that were written; failures: in a line each, the moments of a loss that could not be.
    """

    def __init__(
        self, config: SnapshotConfig, metadata: Metadata | None = None, attachments: Iterable[Attachment] = ()
    ) -> None:
        self.saved: list[Path] = []
        self.failures: list[str] = []
        self._config = config
        self._metadata, self._attachments = dict(metadata or {}), list(attachments)
        self._ring = Ring(config.seconds, config.max_bytes)
        self._states: dict[str, TrackingState] = {}
        self._losses = 0
        self._saving = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._log = stage_logger("recorder")

    def add(self, key: str, topic: Topic[Any], payload: bytes, received_ns: int) -> None:
        """Keep a message; where it says that tracking has just been lost, what came up to it is written."""
        self._ring.add(key, topic, payload, received_ns)
        if topic is STATE and self._config.when_lost and self._is_loss(key, payload):
            self._save_loss(key)

    def save(self, seconds: float, why: str = "asked") -> SnapshotSaved:
        """Write what came in the last seconds. Raises RefusedError where that is nothing, and RecordingError."""
        items = self._ring.last(seconds)
        if not items:
            raise RefusedError("nothing has come yet that could be saved; ask again once the pipeline runs")
        return self._write(items, seconds, why)

    def close(self) -> None:
        """Return once nothing is being written any more."""
        for thread in self._threads:
            thread.join()

    def _is_loss(self, key: str, payload: bytes) -> bool:
        try:
            state = decode(payload, STATE.message_type, STATE.max_bytes).state
        except CodecError:
            return False
        before = self._states.get(key)
        self._states[key] = state
        return state is TrackingState.LOST and before not in (None, TrackingState.LOST)

    def _save_loss(self, key: str) -> None:
        self._losses += 1
        if self._losses > self._config.most_lost:
            if self._losses == self._config.most_lost + 1:
                self._log.warning("lost again; no more of this run is saved", saved=self._config.most_lost)
            return
        # In this thread are what came up to now; writing it must not keep the next messages waiting.
        items = self._ring.last(self._config.seconds)
        thread = threading.Thread(target=self._save_in_thread, args=(items, key), name="snapshot")
        self._threads = [*(each for each in self._threads if each.is_alive()), thread]
        thread.start()

    def _save_in_thread(self, items: list[_Kept], key: str) -> None:
        try:
            saved = self._write(items, self._config.seconds, "lost", key)
        except Exception as error:
            self.failures.append(reason(error))
            self._log.error("the moment of a loss could not be saved", error=reason(error))
        else:
            self._log.info("tracking was lost; what came before is saved", path=saved.path)

    def _write(self, items: list[_Kept], seconds: float, why: str, key: str | None = None) -> SnapshotSaved:
        with self._saving:
            path = self._new_path(why)
            held = (items[-1].received_ns - items[0].received_ns) / 1e9
            about = {"why": why, "seconds_wanted": f"{seconds:g}", "seconds": f"{held:.3f}"}
            about |= {} if key is None else {"key": key}
            writer = RecordingWriter(path, {**self._metadata, SNAPSHOT_RECORD: about}, self._attachments)
            try:
                for item in items:
                    writer.write_payload(*item)
            except Exception as error:
                writer.discard()
                raise RecordingError(f"{path}: cannot be written: {reason(error)}; nothing was") from error
            writer.finish()
            self.saved.append(path)
        return SnapshotSaved(path=str(path), seconds=held, messages=writer.messages)

    def _new_path(self, why: str) -> Path:
        stem = f"{why}-{time.strftime('%Y%m%d-%H%M%S')}"
        number = 1
        while True:
            path = self._config.folder / f"{stem}{'' if number == 1 else f'-{number}'}.mcap"
            if not path.exists() and unfinished_file(path) is None:
                return path
            number += 1
