"""A live run in a time of its own: what comes when, and that it is the same each time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldpose.bus.messages import Frame, Guess, Reason, State, TrackingState, Truth
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.evaluation.edited import Recipe, edit_recording, read_visibility
from fieldpose.deploy.local import Said
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings, changed
from fieldpose.deploy.simulation import Delays, Simulation
from fieldpose.stages.geometry import rotation_error_deg, translation_error

FIELD = demo_file("field.safetensors")
VIDEO: dict[str, Any] = {
    "rendering": {"size": 160},
    "camera": {"source": f"mcap:{demo_file('sequence.mcap')}", "pace": "live"},
}
FRAMES = 14


def said(delays: Delays) -> list[Said]:
    """Everything until some frames have been answered."""
    messages, answered = [], 0
    for each in Simulation(Parts(planned(changed(Settings(), VIDEO, "test"), FIELD), together=True), delays).play():
        messages.append(each)
        answered += isinstance(each.message, State)
        if answered == FRAMES:
            break
    return messages


def states(messages: list[Said]) -> list[State]:
    return [each.message for each in messages if isinstance(each.message, State)]


@pytest.fixture(scope="module")
def usual() -> list[Said]:
    return said(Delays())


def test_every_frame_is_answered_at_once_and_in_order(usual: list[Said]) -> None:
    kinds = [each.message for each in usual if isinstance(each.message, Frame | State)]
    assert [type(message) for message in kinds] == [Frame, State] * FRAMES
    ids = [message.header.frame_id for message in kinds]
    assert ids[::2] == ids[1::2] == sorted(set(ids))


def test_the_same_is_said_each_time(usual: list[Said]) -> None:
    again = said(Delays())
    assert [each.topic for each in again] == [each.topic for each in usual]
    for one, other in zip(states(usual), states(again), strict=True):
        assert (one.state, one.score, one.in_flight) == (other.state, other.score, other.in_flight)
        assert (one.cam_from_object is None) == (other.cam_from_object is None)
        if one.cam_from_object is not None:
            np.testing.assert_array_equal(one.cam_from_object, other.cam_from_object)


def test_frames_are_asked_for_in_the_order_of_their_times(usual: list[Said]) -> None:
    asked = [each.message.header.frame_id for each in usual if isinstance(each.message, Guess)]
    assert asked
    assert asked == sorted(asked)


def test_the_later_solves_are_the_later_tracking_begins(usual: list[Said]) -> None:
    late = said(Delays(look_ms=40, view_ms=60, solve_ms=100_000))
    assert all(state.state is TrackingState.INITIALIZING for state in states(late))
    assert states(usual)[-1].state is TrackingState.TRACKING


@pytest.mark.parametrize("name", ["black", "flicker", "blur", "swapped", "stamps", "focal", "missing"])
def test_no_pose_that_is_said_to_be_tracking_is_wrong_and_tracking_comes_back(name: str, tmp_path: Path) -> None:
    """On a part of the demo's sequence that is disturbed, with solves as late as on a slow machine."""
    source = tmp_path / "edited.mcap"
    edit_recording(demo_file("sequence.mcap"), source, name, Recipe(seconds=4.0, every=2))
    settings = changed(Settings(), {"camera": {"source": f"mcap:{source}"}}, "test")
    simulation = Simulation(Parts(planned(settings, FIELD), together=True), Delays(40.0, 160.0, 400.0))
    messages, visible = list(simulation.play()), read_visibility(source)
    truth = {each.message.header.frame_id: each.message.cam_from_object
             for each in messages if isinstance(each.message, Truth)}  # fmt: skip
    found = states(messages)
    assert len(found) == len(truth)
    sure = [state for state in found if state.state is TrackingState.TRACKING]
    for state in sure:
        pose, true = state.cam_from_object, truth[state.header.frame_id]
        assert pose is not None
        assert true is not None
        assert visible[state.header.frame_id] > 0
        assert rotation_error_deg(pose, true) < 5
        assert translation_error(pose, true) < 0.05 * np.linalg.norm(true[:3, 3])
    if name == "focal":
        assert {state.state for state in found[-20:]} == {TrackingState.LIMITED}
        assert found[-1].reason is Reason.CAMERA_DIFFERS
    else:
        assert found[-1].state is TrackingState.TRACKING
        assert len(sure) > 0.6 * len(found)
