"""Asking something of a pipeline that is running."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from fieldpose.bus.control import ask_stage
from fieldpose.bus.requests import (
    MOST_SOLVES_PER_S,
    ControlValues,
    Request,
    Reset,
    SetGuess,
    SetSolving,
    Show,
    TakeKeyframe,
)
from fieldpose.bus.topics import Address
from fieldpose.bus.transport import LOCAL_HUB
from fieldpose.deploy.access.joining import Entry, joined
from fieldpose.deploy.access.roles import OPERATOR
from fieldpose.errors import ConfigError, RefusedError, UsageError
from fieldpose.stages.tracking.beginning import beginning

_HUB_S = 5.0
_TRACKING = "tracking"


@dataclass(frozen=True)
class Options:
    """Ask something of a pipeline that is running; prints a line for each that answers.

    Example: fieldpose control guess train:047 --field out/mine.safetensors --connect tcp/127.0.0.1:7447

    show: how tracking is. reset: forget what is believed of the camera, and begin again as the run has begun. guess
    GUESS: begin again at a pose. solve RATE: solve a frame at least so often a second, where frames are followed; 0:
    only where following needs it. keyframe: solve the next frame that is followed well, and keep its view for
    following, whatever comes after it, if the solve bears out what was followed; the newest eight are kept. What was
    accepted stands in recordings, under the topic `control`, and is forgotten where the process of tracking has to be
    started again.
    """

    action: tyro.conf.Positional[Literal["show", "reset", "guess", "solve", "keyframe"]]
    """What to do."""
    value: tyro.conf.Positional[str | None] = None
    """For guess: train:NAME, with --field, or a JSON file {"cam_from_object": 4x4}; for solve: 0 to 100 a second."""
    connect: str = LOCAL_HUB
    """Where the hub is; `fieldpose run` says it when it starts."""
    field: Path | None = None
    """The field (.safetensors) that has the training view."""
    timeout_s: float = 5.0
    """How long to wait for an answer."""
    entry: Annotated[Entry, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Entry)
    address: Annotated[Address, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Address)
    """Which pipelines: a part may be "*"."""

    def run(self) -> int:
        """Ask, and print what is answered. Raises RefusedError, and TransportError where nobody answers."""
        request = self.request()
        with joined(self.connect, self.entry, (OPERATOR,), _HUB_S) as bus:
            bus.settle(_HUB_S)  # or some of several pipelines might not be known yet
            values, refusals = ask_stage(bus, self.address, _TRACKING, request, self.timeout_s)
        for key, each in values.items():
            print(f"{key}: {in_words(each)}")
        if refusals:
            raise RefusedError("; ".join(refusals))
        return 0

    def request(self) -> Request[ControlValues]:
        """What is asked. Raises UsageError and ConfigError."""
        if self.timeout_s <= 0:
            raise UsageError(f"--timeout-s is {self.timeout_s:g}, but must be above 0")
        if self.action in _PLAIN:
            if self.value is not None:
                raise UsageError(f"{self.action} takes no value, got {self.value!r}")
            return _PLAIN[self.action]()
        if self.value is None:
            raise UsageError(f"{self.action} needs a value, as in `fieldpose control {_EXAMPLES[self.action]}`")
        return _guess(self.value, self.field) if self.action == "guess" else _solving(self.value)


_PLAIN: dict[str, Callable[[], Request[ControlValues]]] = {"show": Show, "reset": Reset, "keyframe": TakeKeyframe}
_EXAMPLES = {"guess": "guess train:047 --field mine.safetensors", "solve": "solve 2"}


def _guess(spec: str, field: Path | None) -> SetGuess:
    views = None
    if spec.startswith("train:"):
        if field is None:
            raise UsageError(f"guess {spec}: give the field that has this view, with --field")
        from fieldpose.stages.nerf.field import load_field
        from fieldpose.stages.nerf.training_views import training_views

        views = training_views(load_field(field))
    start = beginning(spec, views).start
    if start is None:
        raise ConfigError(f"guess {spec}: tells of frames; give train:NAME or a file with one pose")
    return SetGuess(cam_from_object=start)


def _solving(text: str) -> SetSolving:
    try:
        return SetSolving(solves_per_s=float(text))
    except ValueError:
        most = f"{MOST_SOLVES_PER_S:g}"
        raise UsageError(f"solve {text!r}: expected a number from 0 to {most}, of frames a second") from None


def in_words(values: ControlValues) -> str:
    """An answer for people."""
    rate = values.solves_per_s
    words = [str(values.state), f"{values.frames} frames"]
    words.append("not followed" if rate is None else f"solved at least {rate:g} times a second")
    if values.keyframes:
        words.append(f"{values.keyframes} keyframe{'s' * (values.keyframes > 1)} taken")
    if values.begins_at is not None:
        words.append("begins at a guess")
    return ", ".join([*words, f"{values.requests} requests carried out"])
