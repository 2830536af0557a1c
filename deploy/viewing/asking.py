"""What the buttons of a page ask of a pipeline that is running, each answered in a line."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fieldpose.bus.control import ask_one
from fieldpose.bus.protocol import Bus
from fieldpose.bus.requests import ControlValues, Request, Reset, SaveSnapshot, SetGuess, Show, TakeKeyframe
from fieldpose.bus.topics import Address
from fieldpose.deploy.graph import RECORDER
from fieldpose.errors import FieldposeError
from fieldpose.stages.geometry import nearest_rigid

SNAPSHOT_S = 10.0
NO_RECORDER = "Saving needs a recorder: run with --record.snapshots DIR, or start fieldpose record --snapshots DIR."
_TRACKING = "tracking"
_ASK_S, _SAVE_S, _KEPT_S, _POLL_S = 3.0, 20.0, 3.0, 0.1


@dataclass(frozen=True)
class Actions:
    """What buttons do, each giving a line of what came of it.

    guess: takes the cam_from_object (4, 4) that the page is looked at from. can_save: whether a recorder is there.
    """

    reset: Callable[[], str]
    guess: Callable[[np.ndarray], str]
    keyframe: Callable[[], str]
    save: Callable[[], str]
    can_save: Callable[[], bool]


def actions_on(bus: Bus, address: Address) -> Actions:
    """Those on the pipeline at an address, and on the recorder beside it."""

    def asked(request: Request[ControlValues]) -> ControlValues:
        return ask_one(bus, address, _TRACKING, request, _ASK_S)

    def reset() -> str:
        asked(Reset())
        return "Tracking begins again."

    def guess(cam_from_object: np.ndarray) -> str:
        asked(SetGuess(cam_from_object=nearest_rigid(cam_from_object)))
        return "Tracking begins again at this guess."

    def keyframe() -> str:
        before = asked(Show()).keyframes
        asked(TakeKeyframe())
        end = time.monotonic() + _KEPT_S
        while time.monotonic() < end:
            if asked(Show()).keyframes != before:
                return "The frame was solved, and its view is kept."
            time.sleep(_POLL_S)
        return "Asked for; no view is kept yet: the solve did not bear out what was followed, or takes longer."

    def save() -> str:
        saved = ask_one(bus, address, RECORDER, SaveSnapshot(seconds=SNAPSHOT_S), _SAVE_S)
        return f"Saved {saved.path}: {saved.messages} messages of {saved.seconds:.1f} s."

    def can_save() -> bool:
        return bool(bus.live(Address(address.site, "*", "*").live(RECORDER)))

    def guess_told(cam_from_object: np.ndarray) -> str:
        return _told(lambda: guess(cam_from_object))

    return Actions(
        lambda: _told(reset), guess_told, lambda: _told(keyframe), lambda: _told(save), can_save,
    )  # fmt: skip


def _told(do: Callable[[], str]) -> str:
    try:
        return do()
    except FieldposeError as error:
        return f"Not done: {error}"
