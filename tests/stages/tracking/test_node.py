"""Camera and tracking as nodes on one bus, with a pipeline that answers every guess with the guess."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
from PIL import Image
from support.posed_images import CAMERA, write_blender

from fieldpose.bus.memory import MemoryBus
from fieldpose.bus.messages import (
    Camera,
    Frame,
    Guess,
    GuessReason,
    Message,
    Pose,
    Reason,
    Retrieved,
    State,
    TrackingState,
    Truth,
)
from fieldpose.bus.node import Handler, Output, first_header, reply_header, run_node
from fieldpose.bus.ports import Inbox
from fieldpose.bus.topics import FRAME, GUESS, POSE, RETRIEVED, STATE, TRUTH, Address, Topic
from fieldpose.errors import ConfigError, FieldFileError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.node import CameraNode
from fieldpose.stages.geometry import rotation_error_deg
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import Field, new_net
from fieldpose.stages.nerf.metadata import FieldMetadata, Space, TrainingCamera
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.node import TrackingNode
from fieldpose.stages.tracking.wire import pose_result

TINY = FieldConfig(levels=2, log2_table=8, hidden=8, occupancy_resolution=8)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A dataset of four training and three test images, and beside it a field that knows the training views."""
    poses = write_blender(tmp_path / "scene", CAMERA.resized(32, 32), counts=(4, 3))
    cameras = [
        TrainingCamera(f"train/r_{i}.png", 32, 32, 30.0, 30.0, 15.5, 15.5, (0.0,) * 5, tuple(pose.ravel().tolist()))
        for i, pose in enumerate(poses[:4])
    ]
    space = Space(contracted=False, centre=(0.0, 0.0, 0.0), scale=1.0)
    metadata = FieldMetadata(space, TINY, (1.0, 1.0, 1.0), cameras, "blender", "")
    Field(metadata, new_net(TINY, np.random.default_rng(0)), np.ones((8, 8, 8), bool)).save(tmp_path / "field")
    return tmp_path


def answer(guess: Guess, ok: bool = True) -> Pose:
    return Pose(
        header=reply_header(guess.header),
        ok=ok,
        reason=Reason.OK if ok else Reason.NO_CONSENSUS,
        cam_from_object=guess.cam_from_object if ok else None,
        covariance=None,
        inliers=100,
        correspondences=120,
        residual_px=1.0,
        refined=False,
        loss_before=None,
        loss_after=None,
    )


class Echo:
    """The five stages between guess and pose, in short."""

    name = "echo"
    inputs: tuple[Topic, ...] = (GUESS,)
    outputs: tuple[Topic, ...] = (POSE,)

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def tick(self, now_ns: int) -> Iterable[Output]:
        return ()

    def handle(self, topic: Topic, message: Message) -> Iterator[Output]:
        assert isinstance(message, Guess)
        yield POSE, answer(message)


@contextmanager
def running(bus: MemoryBus, *handlers: Handler) -> Iterator[list[threading.Thread]]:
    stop = threading.Event()
    threads = [
        threading.Thread(target=run_node, args=(handler, bus, Address(), stop), daemon=True) for handler in handlers
    ]
    for thread in threads:
        thread.start()
    try:
        yield threads
    finally:
        stop.set()
        for thread in threads:
            thread.join(10)
        assert not any(thread.is_alive() for thread in threads)


def wait_for_live(bus: MemoryBus, *names: str) -> None:
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        if {Address().live(name) for name in names} <= bus.live(Address().live("*")):
            return
        time.sleep(0.005)
    raise AssertionError("not ready")


def run_through(scene: Path, camera: CameraConfig, tracking: TrackingConfig) -> list[Message]:
    """All messages of a run, in the order of their sending, after the camera has ended by itself."""
    bus = MemoryBus()
    inbox = Inbox(bus, Address(), (FRAME, TRUTH, GUESS, STATE), dict.fromkeys((FRAME, TRUTH, GUESS, STATE), 1000))
    node = CameraNode(camera, lambda: wait_for_live(bus, "tracking", "echo"))
    with running(bus, TrackingNode(scene / "field", tracking), Echo(), node) as threads:
        threads[2].join(15)
        assert not threads[2].is_alive()
    return [received.message for received in inbox.drain()]


def test_every_test_image_gets_its_disturbed_guess_and_an_answer(scene: Path) -> None:
    camera = CameraConfig(f"dataset:{scene / 'scene'}:test")
    messages = run_through(scene, camera, TrackingConfig(guess="perturb:10-40deg,0.2"))
    kinds = [type(message).__name__ for message in messages]
    assert kinds == ["Truth", "Frame", "Guess", "State"] * 3
    assert [message.header.frame_id for message in messages] == [i for i in range(3) for _ in range(4)]
    for truth, _, guess, state in zip(*[iter(messages)] * 4, strict=True):
        assert 10 <= rotation_error_deg(truth.cam_from_object, guess.cam_from_object) <= 40
        assert guess.reason is GuessReason.PRIOR
        assert state.state is TrackingState.TRACKING
        np.testing.assert_array_equal(state.cam_from_object, guess.cam_from_object)
        assert guess.header.capture_ns == truth.header.capture_ns == state.header.capture_ns
    last = messages[-1]
    assert isinstance(last, State)
    assert (last.admitted, last.finished, last.in_flight, last.lost, last.dropped_at_the_door) == (3, 3, 0, 0, 0)


def test_tracking_starts_at_the_training_view_that_it_is_told(scene: Path) -> None:
    for i in range(3):
        Image.new("RGB", (32, 32)).save(scene / f"photo{i}.png")
    tracking = TrackingConfig(guess="train:r_2", sequence="photos")
    messages = run_through(scene, CameraConfig(f"folder:{scene}"), tracking)
    guesses = [message for message in messages if isinstance(message, Guess)]
    assert [guess.reason for guess in guesses] == [GuessReason.PRIOR, GuessReason.KEYFRAME, GuessReason.KEYFRAME]
    assert not any(isinstance(message, Truth) for message in messages)
    states = [message.state for message in messages if isinstance(message, State)]
    assert states == [TrackingState.TRACKING] * 3


def test_a_bad_field_or_guess_is_refused_at_start(scene: Path) -> None:
    with pytest.raises(FieldFileError):
        TrackingNode(scene / "none", TrackingConfig()).start()
    with pytest.raises(ConfigError):
        TrackingNode(scene / "field", TrackingConfig(guess="nowhere.json")).start()


def test_frames_skipped_by_the_bus_are_counted_at_the_door(scene: Path) -> None:
    node = TrackingNode(scene / "field", TrackingConfig(depth=4))
    node.start()
    model = Camera(32, 32, 30.0, 30.0, 15.5, 15.5)
    for sequence in (0, 3):
        header = msgspec.structs.replace(first_header(sequence, sequence), source="camera", sequence=sequence)
        frame = Frame(header=header, image=np.zeros((32, 32, 3), np.uint8), encoding="rgb8", camera=model)
        guess = next(iter(node.handle(FRAME, frame)))[1]
    state = next(message for topic, message in node.handle(POSE, answer(guess)) if topic is STATE)
    assert (state.admitted, state.dropped_at_the_door) == (2, 2)


def test_what_retrieval_names_is_tried_next(scene: Path) -> None:
    node = TrackingNode(scene / "field", TrackingConfig())
    node.start()
    header = first_header(0, 5)
    model = Camera(32, 32, 30.0, 30.0, 15.5, 15.5)
    frame = Frame(header=header, image=np.zeros((32, 32, 3), np.uint8), encoding="rgb8", camera=model)
    guess = next(iter(node.handle(FRAME, frame)))[1]
    assert isinstance(guess, Guess)
    assert guess.reason is GuessReason.RELOCALISATION
    named = np.eye(4)
    named[2, 3] = 7.0
    retrieved = Retrieved(
        header=reply_header(guess.header), ok=True, reason=Reason.OK, cam_from_object=named[None],
        similarity=np.ones(1, np.float32),
    )  # fmt: skip
    assert not list(node.handle(RETRIEVED, retrieved))
    again = next(message for topic, message in node.handle(POSE, answer(guess, ok=False)) if topic is GUESS)
    assert isinstance(again, Guess)
    np.testing.assert_array_equal(again.cam_from_object, named)


def test_a_pose_that_is_no_rigid_transform_is_a_failure() -> None:
    model = Camera(32, 32, 30.0, 30.0, 15.5, 15.5)
    good = Guess(header=first_header(0, 0), reason=GuessReason.PRIOR, cam_from_object=np.eye(4), camera=model)
    assert pose_result(answer(good)).ok
    sheared = np.eye(4)
    sheared[0, 1] = 0.5
    bad = Guess(header=first_header(0, 0), reason=GuessReason.PRIOR, cam_from_object=sheared, camera=model)
    assert not pose_result(answer(bad)).ok
    assert not pose_result(answer(good, ok=False)).ok
