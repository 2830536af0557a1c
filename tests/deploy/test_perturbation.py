"""Guesses that are made from the truth: where they lie, that they repeat, and that tracking begins with them."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from support.posed_images import CAMERA, write_blender
from support.tracking_world import on_sphere, ring_of_views

from fieldpose.bus.messages import (
    CameraInfo,
    Guess,
    GuessReason,
    Message,
    Pose,
    Prior,
    Reason,
    State,
    TrackingState,
    Truth,
)
from fieldpose.bus.node import EndOfInput, Handler, Output, first_header, reply_header
from fieldpose.bus.topics import CAMERA_INFO, GUESS, POSE, PRIOR, TRUTH, Topic
from fieldpose.deploy.evaluation.perturbation import PerturbationNode
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.node import CameraNode
from fieldpose.stages.geometry import Similarity, camera_centre, is_rigid, rotation_about, rotation_error_deg
from fieldpose.stages.tracking.beginning import Disturbance, beginning, make_policy
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.core import Tracker
from fieldpose.stages.tracking.node import TrackingNode

SPEC = "perturb:10-40deg,0.2"
VIEWS = ring_of_views()


def priors(node: PerturbationNode, frame_ids: Iterable[int], truth: np.ndarray | None) -> dict[int, np.ndarray]:
    """The guesses for frames of that true pose, by their frame_id."""
    made: dict[int, np.ndarray] = {}
    for frame_id in frame_ids:
        for topic, message in node.handle(TRUTH, Truth(header=first_header(frame_id, 77), cam_from_object=truth)):
            assert topic is PRIOR
            assert isinstance(message, Prior)
            assert (message.header.frame_id, message.header.capture_ns) == (frame_id, 77)
            made[frame_id] = message.cam_from_object
    return made


def disturbed(spec: str = SPEC, seed: int = 0) -> PerturbationNode:
    node = PerturbationNode(beginning(spec, None).disturbance, seed)
    node.start()
    return node


def test_disturbed_guesses_lie_where_the_paper_says() -> None:
    truth = on_sphere(20, 30)
    guesses = priors(disturbed(), range(200), truth).values()
    angles = [rotation_error_deg(guess, truth) for guess in guesses]
    assert 10 - 1e-6 <= min(angles) < 15
    assert 35 < max(angles) <= 40 + 1e-6
    shifts = [abs(np.linalg.norm(camera_centre(guess)) - 4.0) for guess in guesses]
    assert 0.1 < max(shifts) <= 0.2 + 1e-9
    assert all(is_rigid(guess, 1e-9) for guess in guesses)


@pytest.mark.parametrize(("spec", "least", "most"), [("perturb:3-4deg,0", 3, 4), ("perturb:90-90deg,0", 90, 90)])
def test_other_disturbances_are_as_large_as_they_say(spec: str, least: float, most: float) -> None:
    truth = on_sphere(20, 30)
    for guess in priors(disturbed(spec), range(20), truth).values():
        assert least - 1e-6 <= rotation_error_deg(guess, truth) <= most + 1e-6
        assert np.linalg.norm(camera_centre(guess)) == pytest.approx(4.0)


def test_without_a_disturbance_it_is_the_papers() -> None:
    truth = on_sphere(20, 30)
    papers = priors(PerturbationNode(Disturbance((10.0, 40.0), 0.2), 5), [3], truth)
    np.testing.assert_array_equal(priors(PerturbationNode(None, 5), [3], truth)[3], papers[3])


def test_disturbances_repeat_by_seed_and_frame_in_whatever_order_the_frames_come() -> None:
    truth = on_sphere(20, 30)
    forwards, backwards = priors(disturbed(seed=1), [0, 1, 2], truth), priors(disturbed(seed=1), [2, 1, 0], truth)
    other = priors(disturbed(seed=2), [0, 1, 2], truth)
    for i in range(3):
        np.testing.assert_array_equal(forwards[i], backwards[i])
        assert not np.allclose(forwards[i], other[i])
    assert not np.allclose(forwards[0], forwards[1])


def test_guesses_are_in_the_fields_frame_where_that_is_another_than_the_truths() -> None:
    truth = on_sphere(20, 30)
    moved = Similarity(2.5, rotation_about(np.array([1.0, 2.0, 3.0]), 0.7)[:3, :3], np.array([1.0, -2.0, 0.5]))
    disturbance = Disturbance((10.0, 40.0), 0.2)
    there = priors(PerturbationNode(disturbance, 5, moved), [3], truth)[3]
    here = priors(PerturbationNode(disturbance, 5), [3], truth)[3]
    np.testing.assert_allclose(there, moved.of_poses(here[None])[0], atol=1e-9)


def test_an_object_out_of_view_has_no_guess() -> None:
    node = disturbed()
    assert priors(node, [0], None) == {}
    assert list(node.tick(10**18)) == []
    assert list(priors(node, [0], np.eye(4))) == [0]


class Echo:
    """The five stages between guess and pose, in short: each guess is right."""

    name = "echo"
    inputs: tuple[Topic, ...] = (GUESS,)
    outputs: tuple[Topic, ...] = (POSE,)

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def tick(self, now_ns: int) -> Iterable[Output]:
        return ()

    def handle(self, topic: Topic, message: Message) -> Iterator[Output]:
        assert isinstance(message, Guess)
        yield (
            POSE,
            Pose(
                header=reply_header(message.header),
                cam_from_object=message.cam_from_object,
                covariance=1e-6 * np.eye(6),
                inliers=100,
                correspondences=120,
                residual_px=1.0,
                refined=False,
                loss_before=None,
                loss_after=None,
            ),
        )


def run_through(camera: CameraNode, *others: Handler) -> list[Message]:
    """Everything that nodes say to each other, one message after another, until the camera ends."""
    nodes: list[Handler] = [camera, *others]
    for node in nodes:
        node.start()
    said: list[Message] = []
    waiting: deque[Output] = deque(camera.tick(10**18))
    try:
        while waiting:
            topic, message = waiting.popleft()
            said.append(message)
            for node in nodes:
                if topic in node.inputs:
                    waiting.extend(node.handle(topic, message))
    except EndOfInput:
        pass
    for node in nodes:
        node.stop()
    return said


def tracking(spec: str = SPEC) -> TrackingNode:
    config = TrackingConfig(guess=spec)
    return TrackingNode(lambda: Tracker(config, make_policy(config, VIEWS, looks=True)))


def test_every_test_image_gets_its_disturbed_guess_and_an_answer(tmp_path: Path) -> None:
    poses = write_blender(tmp_path, CAMERA.resized(32, 32), counts=(4, 3))
    camera = CameraNode(CameraConfig(f"dataset:{tmp_path}:test"))
    said = run_through(camera, disturbed(), tracking(), Echo())
    by_frame = [[message for message in said if message.header.frame_id == i] for i in range(3)]
    assert sum(len(messages) for messages in by_frame) == len(said)
    for i, (messages, pose) in enumerate(zip(by_frame, poses[4:], strict=True)):
        kinds = sorted(type(message).__name__ for message in messages)
        assert kinds == ["CameraInfo", "Frame", "Guess", "Pose", "Prior", "State", "Truth"]
        (guess,) = (message for message in messages if isinstance(message, Guess))
        (state,) = (message for message in messages if isinstance(message, State))
        assert guess.reason is GuessReason.PRIOR
        assert 10 <= rotation_error_deg(pose, guess.cam_from_object) <= 40
        np.testing.assert_allclose(guess.cam_from_object, priors(disturbed(), [i], pose)[i], atol=1e-6)
        assert state.state is TrackingState.TRACKING
        np.testing.assert_array_equal(state.cam_from_object, guess.cam_from_object)
    last = next(message for message in reversed(said) if isinstance(message, State))
    assert (last.admitted, last.finished, last.in_flight, last.lost, last.dropped_at_the_door) == (3, 3, 0, 0, 0)


def test_a_frame_waits_for_its_guess_and_is_given_up_where_the_object_is_out_of_view() -> None:
    node, perturbation = tracking(), disturbed()
    node.start()
    info = CameraInfo(header=first_header(0, 77), camera=CAMERA)
    assert list(node.handle(CAMERA_INFO, info)) == []
    for frame_id, truth in ((0, None), (1, np.eye(4))):
        for topic, prior in perturbation.handle(TRUTH, Truth(header=first_header(frame_id, 77), cam_from_object=truth)):
            assert list(node.handle(topic, prior)) == []
    ((_, state),) = node.tick(time.time_ns() + 10_000_000_000)
    assert isinstance(state, State)
    assert (state.header.frame_id, state.state, state.reason) == (0, TrackingState.LOST, Reason.NO_GUESS)
    assert (state.admitted, state.dropped_at_the_door) == (0, 1)
    ((topic, guess),) = node.handle(CAMERA_INFO, CameraInfo(header=first_header(1, 77), camera=CAMERA))
    assert (topic, guess.reason) == (GUESS, GuessReason.PRIOR)
