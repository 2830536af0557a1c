"""Message by message and field by field: what was recorded, and what the same stages say now."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fieldpose.bus.messages import Failure, Message, State
from fieldpose.bus.topics import Topic
from fieldpose.stages.geometry import rotation_error_deg, translation_error

_POSE = "cam_from_object"
_Key = tuple[str, int, int, str]


@dataclass
class FieldDifference:
    """In how many messages a field differs, and by how much at most; None where that cannot be said in a number."""

    messages: int = 0
    largest: float | None = None


@dataclass
class TopicComparison:
    """Of one topic: messages in both, of which so many are the same in each bit of each field, and in one alone.

    poses: recorded messages in both with a pose, of states with one that tracking was sure of; new: those that have one
    only now. rotation_deg, translation: how far that of the other is from it, in the field's unit, where that has one.
    distance: of each recorded pose from the origin.
    """

    both: int = 0
    same: int = 0
    only_recorded: int = 0
    only_replayed: int = 0
    fields: dict[str, FieldDifference] = field(default_factory=dict)
    poses: int = 0
    new: int = 0
    rotation_deg: list[float] = field(default_factory=list)
    translation: list[float] = field(default_factory=list)
    distance: list[float] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Whether nothing at all differs."""
        return self.both == self.same and self.only_recorded == self.only_replayed == 0

    def share_within(self, rotation_deg: float, translation_share: float) -> float:
        """Of the recorded poses, those of which what is said now is at most so far apart.

        translation_share: of the median distance from the origin, which is known in each unit.
        """
        limit = translation_share * float(np.median(self.distance)) if self.distance else 0.0
        pairs = zip(self.rotation_deg, self.translation, strict=True)
        near = sum(turn <= rotation_deg and shift <= limit for turn, shift in pairs)
        recorded = self.poses + self.only_recorded
        return near / recorded if recorded else 1.0


class Comparison:
    """Pairs each message with its counterpart, by topic, frame, pass and sender, whichever of them comes first.

    Headers are not compared: when a frame was taken, who sent what under which number, is another matter in each run.
    """

    def __init__(self) -> None:
        self._topics: dict[str, TopicComparison] = {}
        self._waiting: tuple[defaultdict[_Key, deque[Message]], ...] = (defaultdict(deque), defaultdict(deque))

    def recorded(self, topic: Topic[Any], message: Message) -> None:
        """Take in a message of the recording."""
        self._take(topic, message, replayed=False)

    def replayed(self, topic: Topic[Any], message: Message) -> None:
        """Take in a message that was said now."""
        self._take(topic, message, replayed=True)

    def topics(self) -> dict[str, TopicComparison]:
        """What has come of it so far, by topic; what has no counterpart yet counts as being in one alone."""
        for replayed, waiting in enumerate(self._waiting):
            alone: defaultdict[str, int] = defaultdict(int)
            for key, messages in waiting.items():
                alone[key[0]] += len(messages)
            for name, of in self._topics.items():
                setattr(of, "only_replayed" if replayed else "only_recorded", alone[name])
        return dict(self._topics)

    def _take(self, topic: Topic[Any], message: Message, replayed: bool) -> None:
        of = self._topics.setdefault(topic.name, TopicComparison())
        key = _key(topic, message)
        counterparts = self._waiting[not replayed]
        if not counterparts[key]:
            counterparts.pop(key)
            self._waiting[replayed][key].append(message)
            return
        other = counterparts[key].popleft()
        if not counterparts[key]:
            counterparts.pop(key)
        _compare(of, other, message)


def _key(topic: Topic[Any], message: Message) -> _Key:
    header = message.header
    stage = message.stage if isinstance(message, Failure) else ""
    return topic.name, header.frame_id, header.pass_index, stage


def _compare(of: TopicComparison, a: Message, b: Message) -> None:
    of.both += 1
    same = True
    for name, largest in _differences(a, b):
        same = False
        found = of.fields.setdefault(name, FieldDifference())
        found.messages += 1
        found.largest = max((value for value in (found.largest, largest) if value is not None), default=None)
    of.same += same
    before, now = _pose(a), _pose(b)
    if before is None:
        of.new += now is not None
        return
    of.poses += 1
    of.distance.append(float(np.linalg.norm(before[:3, 3])))
    if now is not None:
        of.rotation_deg.append(rotation_error_deg(before, now))
        of.translation.append(translation_error(before, now))


def _pose(message: Message) -> np.ndarray | None:
    """The pose that a message says something of; that of many, as candidates are, is none."""
    if isinstance(message, State) and not message.is_sure:
        return None
    pose: np.ndarray | None = getattr(message, _POSE, None)
    return pose if pose is not None and pose.ndim == 2 else None


def _differences(a: Message, b: Message) -> Iterator[tuple[str, float | None]]:
    """The fields that differ, each with the largest difference of their numbers where they have as many."""
    for name in a.__struct_fields__:
        before, now = getattr(a, name), getattr(b, name)
        if name == "header":
            continue
        if isinstance(before, np.ndarray) and isinstance(now, np.ndarray):
            if before.shape != now.shape:
                yield name, None
            elif not np.array_equal(before, now):
                yield name, float(np.abs(before.astype(np.float64) - now.astype(np.float64)).max())
        elif type(before) is not type(now) or before != now:
            numbers = isinstance(before, int | float) and isinstance(now, int | float)
            yield name, abs(before - now) if numbers else None
