"""Several processes of one stage, which share the pipelines of a site between them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from fieldpose.errors import UsageError

T = TypeVar("T")

_SHARE = re.compile(r"(\d{1,6})/(\d{1,6})")


@dataclass(frozen=True)
class Share:
    """The part of worker `number` of `of`, counted from 1.

    A pipeline is all one worker's, so that each message is handled once, in order, by whom remembers its views; nothing
    must be agreed on while it runs. Each gets as many pipelines as another, or one more, and neighbours in the list,
    which goes camera by camera: a camera's frames then go to as few workers as can be.
    """

    number: int
    of: int

    @staticmethod
    def parse(text: str) -> Share:
        """Of 1/2 for instance. Raises UsageError."""
        found = _SHARE.fullmatch(text)
        share = Share(int(found[1]), int(found[2])) if found else Share(0, 0)
        if not 1 <= share.number <= share.of:
            raise UsageError(f"share {text!r}: expected NUMBER/OF, as 1/2 and 2/2 of two workers")
        return share

    def take(self, pipelines: Sequence[T]) -> list[T]:
        """Its pipelines of all. Raises UsageError where there are fewer than workers."""
        if self.of > len(pipelines):
            raise UsageError(f"share {self}: {len(pipelines)} pipelines cannot be shared by {self.of} processes")
        return list(pipelines[(self.number - 1) * len(pipelines) // self.of : self.number * len(pipelines) // self.of])

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"
