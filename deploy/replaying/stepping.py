"""Going through a replay message by message at a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from enum import Enum
from typing import Any

import numpy as np

from fieldpose.bus.messages import Message
from fieldpose.deploy.replaying.feeding import Played

END = "q"


def step_through(played: Iterator[Played], show: Callable[[str], None], ask: Callable[[str], str]) -> bool:
    """Show each message that was fed and what was said, and `ask` before the next; False where `q` ended that."""
    for one in played:
        header = one.message.header
        show(f"frame {header.frame_id}, pass {header.pass_index}: {one.topic.name}: {in_words(one.message)}")
        for said in one.said:
            show(f"  {said.sender}, {said.ms:.1f} ms -> {said.topic.name}: {in_words(said.message)}")
        if one.said and ask("Enter for the next, q to end: ").strip() == END:
            return False
    return True


def in_words(message: Message) -> str:
    """A message's fields in one line, arrays by their shapes but for a pose's place."""
    parts = (_field(name, getattr(message, name)) for name in message.__struct_fields__ if name != "header")
    return ", ".join(part for part in parts if part)


def _field(name: str, value: Any) -> str:
    if isinstance(value, np.ndarray):
        if name == "cam_from_object" and value.shape == (4, 4):
            return f"t {np.array2string(value[:3, 3], precision=4, suppress_small=True)}"
        if value.dtype == bool:
            return f"{name} {int(value.sum())} of {value.size}"
        return f"{name} {'x'.join(map(str, value.shape))}"
    if value is None:
        return ""
    if isinstance(value, Enum):
        return f"{name} {value.value}"
    if isinstance(value, float):
        return f"{name} {value:.4g}"
    return f"{name} {value}" if isinstance(value, str | int | bool) else ""
