"""Values that are kept for those who come again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

V = TypeVar("V")


class LastUsed(Generic[V]):
    """The `capacity` values that were used last, by key; a key of None is never kept."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._values: OrderedDict[Hashable, V] = OrderedDict()

    def get(self, key: Hashable | None, make: Callable[[], V]) -> V:
        """The value of the key, made where it is not known (any more)."""
        if key is None:
            return make()
        value = self._values.pop(key) if key in self._values else make()
        self._values[key] = value
        while len(self._values) > self._capacity:
            self._values.popitem(last=False)
        return value

    def __contains__(self, key: Hashable | None) -> bool:
        return key in self._values
