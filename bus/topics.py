"""The one table of topics: what goes under which key, how it is queued, how urgent it is, whether recorded."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

from fieldpose.bus import messages
from fieldpose.errors import TransportError

M = TypeVar("M", bound=messages.Message)

_PART_OF_KEY = r"[A-Za-z0-9_.\-]+"
_PART = re.compile(_PART_OF_KEY + r"|\*")


@dataclass(frozen=True)
class Address:
    """One pipeline: an (object, camera) pair at a site. Any part may be "*" to listen to several."""

    site: str = "fieldpose"
    object: str = "object"
    camera: str = "camera0"

    def __post_init__(self) -> None:
        for name in ("site", "object", "camera"):
            _check_part(name, getattr(self, name))

    @property
    def pair(self) -> str:
        """OBJECT/CAMERA, its name among those of its site."""
        return f"{self.object}/{self.camera}"

    def key(self, topic: Topic[Any], stage: str = "*") -> str:
        """The key of `topic` here; only the key of STATS names the stage that sends it."""
        _check_part("stage", stage)
        return topic.template.format(site=self.site, object=self.object, camera=self.camera, stage=stage)

    def covers(self, key: str) -> bool:
        """Whether a concrete key of a topic is one that this pipeline sends or receives on."""
        return any(key_matches(self.key(topic), key) for topic in ALL)

    def live(self, stage: str) -> str:
        """The key of the liveliness token that `stage` holds while it is ready."""
        _check_part("stage", stage)
        return f"{self.site}/live/{self.object}/{self.camera}/{stage}"

    def sender(self, stage: str, instance: int | None = None) -> str:
        """The key of the token by which the sender `stage` of that instance tells that it is there; None: of any."""
        _check_part("stage", stage)
        return f"{self.site}/sender/{self.object}/{self.camera}/{stage}/{'*' if instance is None else instance}"

    def control(self, stage: str) -> str:
        """The key under which `stage` answers requests while it is ready, where it takes any."""
        _check_part("stage", stage)
        return f"{self.site}/control/{self.object}/{self.camera}/{stage}"


def shared_address(addresses: Sequence[Address]) -> Address:
    """One that listens to all of these, which are at one site: "*" in the parts in which they differ."""
    parts = {name: {getattr(address, name) for address in addresses} for name in ("site", "object", "camera")}
    return Address(**{name: found.pop() if len(found) == 1 else "*" for name, found in parts.items()})


def key_matches(pattern: str, key: str) -> bool:
    """Whether a concrete key is one that `pattern` listens to."""
    parts, others = pattern.split("/"), key.split("/")
    return len(parts) == len(others) and all(a in ("*", b) for a, b in zip(parts, others, strict=True))


def keys_meet(a: str, b: str) -> bool:
    """Whether there is a concrete key that both patterns listen to."""
    parts, others = a.split("/"), b.split("/")
    return len(parts) == len(others) and all(x == y or "*" in (x, y) for x, y in zip(parts, others, strict=True))


def _check_part(name: str, part: str) -> None:
    if not _PART.fullmatch(part):
        raise TransportError(f"{name} {part!r}: a part of a key has letters, digits, '_', '.' and '-', or is '*'")


@dataclass(frozen=True, eq=False)
class Topic(Generic[M]):
    """A row of the table, generic in its message; each topic is one object, compared by identity.

    `capacity` bounds a receiver's queue, in messages: the oldest is dropped for a newer one, so 1 is newest-only.
    A stage that joins several inputs keeps `JOIN_CAPACITY` of a newest-only topic instead. `of_frame`: there is one a
    frame, whatever pass over it is asked for. `writers`: the stages that send it, where they run; others may, of which
    STATS has its writer in its key.
    """

    name: str
    template: str
    message_type: type[M]
    capacity: int = 64
    max_bytes: int = 4 << 20
    priority: Literal["data", "data_low"] = "data"
    recorded: bool = True
    of_frame: bool = False
    writers: tuple[str, ...] = ()

    @property
    def newest_only(self) -> bool:
        return self.capacity == 1

    def address_of(self, key: str) -> Address | None:
        """The pipeline that a concrete key of this topic belongs to; None where it is another topic's key."""
        found = re.fullmatch(self.template.format(**_GROUPS), key)
        return Address(**{name: part for name, part in found.groupdict().items() if name != "stage"}) if found else None


_GROUPS = {name: f"(?P<{name}>{_PART_OF_KEY})" for name in ("site", "object", "camera", "stage")}

JOIN_CAPACITY = 64

_PIPELINE = "{site}/track/{object}/{camera}/"
_SOLVING = ("retrieval", "rendering", "matching", "lifting", "pnp", "refinement")
_IMAGE_BYTES, _SMALL = 80 << 20, 64 << 10

FRAME = Topic(
    "frame", "{site}/camera/{camera}/frame", messages.Frame, writers=("camera",), capacity=1, max_bytes=_IMAGE_BYTES,
    priority="data_low", of_frame=True,
)  # fmt: skip
CAMERA_INFO = Topic(
    "camera_info",
    "{site}/camera/{camera}/info",
    messages.CameraInfo,
    writers=("camera",),
    capacity=1,
    max_bytes=_SMALL,
    of_frame=True,
)
TRUTH = Topic("truth", _PIPELINE + "truth", messages.Truth, writers=("camera",), max_bytes=_SMALL, of_frame=True)
PRIOR = Topic("prior", _PIPELINE + "prior", messages.Prior, writers=("perturbation",), max_bytes=_SMALL, of_frame=True)
SEARCH = Topic("search", _PIPELINE + "search", messages.Search, writers=("tracking",), max_bytes=_SMALL)
RETRIEVED = Topic("retrieved", _PIPELINE + "retrieved", messages.Retrieved, writers=("retrieval",), max_bytes=_SMALL)
GUESS = Topic("guess", _PIPELINE + "guess", messages.Guess, writers=("tracking",), max_bytes=_SMALL)
VIEW = Topic(
    "view",
    _PIPELINE + "view",
    messages.View,
    writers=("rendering",),
    capacity=16,
    max_bytes=_IMAGE_BYTES,
    priority="data_low",
)
MATCHES = Topic("matches", _PIPELINE + "matches", messages.Matches, writers=("matching",))
CORRESPONDENCES = Topic(
    "correspondences", _PIPELINE + "correspondences", messages.Correspondences, writers=("lifting",)
)
ESTIMATE = Topic("estimate", _PIPELINE + "estimate", messages.Estimate, writers=("pnp",))
POSE = Topic("pose", _PIPELINE + "pose", messages.Pose, writers=("refinement",), max_bytes=_SMALL)
FAILURE = Topic("failure", _PIPELINE + "failure", messages.Failure, writers=_SOLVING, max_bytes=_SMALL)
FOLLOWED = Topic("followed", _PIPELINE + "followed", messages.Followed, writers=("tracking",), max_bytes=_SMALL)
STATE = Topic("state", _PIPELINE + "state", messages.State, writers=("tracking",), max_bytes=_SMALL)
CONTROL = Topic("control", _PIPELINE + "control", messages.Control, writers=("tracking",), max_bytes=_SMALL)
STATS = Topic("stats", "{site}/stats/{object}/{camera}/{stage}", messages.Stats, capacity=256, max_bytes=16 << 10)

ALL: tuple[Topic[Any], ...] = (
    FRAME, CAMERA_INFO, TRUTH, PRIOR, SEARCH, RETRIEVED, GUESS, VIEW, MATCHES, CORRESPONDENCES, ESTIMATE, POSE, FAILURE,
    FOLLOWED, STATE, CONTROL, STATS,
)  # fmt: skip
BY_NAME: dict[str, Topic[Any]] = {topic.name: topic for topic in ALL}


def topic_of(key: str) -> Topic[Any] | None:
    """The topic that a concrete key belongs to, None where it is none of ours."""
    return next((topic for topic in ALL if topic.address_of(key)), None)
