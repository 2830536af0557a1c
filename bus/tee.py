"""Several stores of one recorder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fieldpose.bus.messages import Header
from fieldpose.bus.recorder import Store
from fieldpose.bus.topics import Topic
from fieldpose.errors import RecordingError


class Tee:
    """Writes everything into each of some stores, and ends all of them where one fails."""

    def __init__(self, stores: Sequence[Store]) -> None:
        self._stores = stores

    @property
    def messages(self) -> int:
        """In the first of them."""
        return self._stores[0].messages

    def take_over(self) -> None:
        told: list[str] = []
        whole: list[Store] = []
        for store in self._stores:
            try:
                store.take_over()
                whole.append(store)
            except RecordingError as error:
                told.append(str(error))
            except Exception as error:
                told.append(str(store.end_early(error)))
        if told:
            why = OSError("its other form cannot be gone on with")
            raise RecordingError("; ".join([*told, *(str(store.end_early(why)) for store in whole)]))

    def write_payload(self, key: str, topic: Topic[Any], payload: bytes, log_time_ns: int) -> None:
        for store in self._stores:
            store.write_payload(key, topic, payload, log_time_ns)

    def note_dropped(self, key: str, header: Header) -> None:
        for store in self._stores:
            store.note_dropped(key, header)

    def note_left_out(self, refused: int, doubted: int) -> None:
        for store in self._stores:
            store.note_left_out(refused, doubted)

    def flush_if_due(self) -> float:
        return min(store.flush_if_due() for store in self._stores)

    def close(self) -> bool:
        lossless = True
        told: list[str] = []
        for store in self._stores:
            try:
                lossless = store.close() and lossless
            except RecordingError as error:
                told.append(str(error))
            except Exception as error:
                told.append(str(store.end_early(error)))
        if told:
            raise RecordingError("; ".join(told))
        return lossless

    def end_early(self, error: Exception) -> RecordingError:
        told = [store.end_early(error) for store in self._stores]
        return RecordingError("; ".join(str(each) for each in told))
