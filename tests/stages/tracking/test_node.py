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
from support.tracking_world import on_sphere

from fieldpose.bus.memory import MemoryBus
from fieldpose.bus.messages import (
    CameraInfo,
    CameraOrigin,
    Failure,
    Frame,
    Guess,
    GuessReason,
    Message,
    Pose,
    Prior,
    Reason,
    Retrieved,
    Search,
    State,
    TrackingState,
    Truth,
)
from fieldpose.bus.node import Handler, Output, first_header, reply_header, run_node
from fieldpose.bus.ports import Inbox
from fieldpose.bus.topics import (
    CAMERA_INFO,
    FAILURE,
    FRAME,
    GUESS,
    POSE,
    PRIOR,
    RETRIEVED,
    SEARCH,
    STATE,
    TRUTH,
    Address,
    Topic,
)
from fieldpose.errors import ConfigError, FieldFileError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.node import CameraNode
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import Field, load_field, new_net
from fieldpose.stages.nerf.metadata import FieldMetadata, Space, TrainingCamera
from fieldpose.stages.nerf.training_views import training_views
from fieldpose.stages.tracking.beginning import make_policy
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.core import Tracker
from fieldpose.stages.tracking.node import TrackingNode
from fieldpose.stages.tracking.wire import pose_result

TINY = FieldConfig(levels=2, log2_table=8, hidden=8, occupancy_resolution=8)
SMALL = Camera(32, 32, 30.0, 30.0, 15.5, 15.5)
EVERYTHING = (TRUTH, FRAME, CAMERA_INFO, SEARCH, GUESS, STATE)


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


def tracking_in(field: Path, looks: bool = False, **config: object) -> TrackingNode:
    """Tracking with the training views of a field, which it reads at its start."""

    def make_tracker() -> Tracker:
        settings = TrackingConfig(**config)  # type: ignore[arg-type]
        return Tracker(settings, make_policy(settings, training_views(load_field(field)), looks))

    return TrackingNode(make_tracker)


def started(field: Path, looks: bool = False, **config: object) -> TrackingNode:
    node = tracking_in(field, looks, **config)
    node.start()
    return node


def answer(guess: Guess) -> Pose:
    return Pose(
        header=reply_header(guess.header),
        cam_from_object=guess.cam_from_object,
        covariance=1e-6 * np.eye(6),
        inliers=100,
        correspondences=120,
        residual_px=1.0,
        refined=False,
        loss_before=None,
        loss_after=None,
    )


def failure(message: Message, stage: str = "pnp", reason: Reason = Reason.NO_CONSENSUS) -> Failure:
    return Failure(header=reply_header(message.header), stage=stage, reason=reason)


def retrieved(search: Message, *poses: np.ndarray) -> Retrieved:
    similarity = np.ones(len(poses), np.float32)
    return Retrieved(header=reply_header(search.header), cam_from_object=np.stack(poses), similarity=similarity)


def info(
    frame_id: int = 0, sequence: int = 0, camera: Camera = SMALL, origin: CameraOrigin = CameraOrigin.CALIBRATED
) -> CameraInfo:
    header = msgspec.structs.replace(first_header(frame_id, 5), source="camera", sequence=sequence)
    return CameraInfo(header=header, camera=camera, camera_origin=origin)


def told(node: TrackingNode, topic: Topic, message: Message) -> list[Message]:
    """What a node says to a message; each on its own topic."""
    said = list(node.handle(topic, message))
    assert all(topic in node.outputs and isinstance(message, topic.message_type) for topic, message in said)
    return [message for _, message in said]


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


def run_through(tracking: TrackingNode, camera: CameraConfig, *known: Camera) -> list[Message]:
    """All messages of a run, in the order of their sending, after the camera has ended by itself."""
    bus = MemoryBus()
    inbox = Inbox(bus, Address(), EVERYTHING, dict.fromkeys(EVERYTHING, 1000))
    node = CameraNode(camera, lambda: known, lambda: wait_for_live(bus, "tracking", "echo"))
    with running(bus, tracking, Echo(), node) as threads:
        threads[2].join(15)
        assert not threads[2].is_alive()
    return [received.message for received in inbox.drain()]


def test_every_test_image_is_answered_before_the_next_is_sent(scene: Path) -> None:
    tracking = tracking_in(scene / "field", guess="train:r_2", sequence="photos")
    messages = run_through(tracking, CameraConfig(f"dataset:{scene / 'scene'}:test"))
    kinds = [type(message).__name__ for message in messages]
    assert kinds == ["Truth", "Frame", "CameraInfo", "Guess", "State"] * 3
    assert [message.header.frame_id for message in messages] == [i for i in range(3) for _ in range(5)]
    for truth, frame, camera_info, guess, state in zip(*[iter(messages)] * 5, strict=True):
        assert guess.reason is GuessReason.PRIOR
        assert guess.camera == camera_info.camera == frame.camera
        assert (state.state, state.camera_origin) == (TrackingState.TRACKING, CameraOrigin.CALIBRATED)
        np.testing.assert_array_equal(state.cam_from_object, guess.cam_from_object)
        assert guess.header.capture_ns == truth.header.capture_ns == state.header.capture_ns
    last = messages[-1]
    assert isinstance(last, State)
    assert (last.admitted, last.finished, last.in_flight, last.lost, last.dropped_at_the_door) == (3, 3, 0, 0, 0)


@pytest.mark.parametrize(
    ("sequence", "known", "expected"),
    [
        ("photos", [SMALL], (CameraOrigin.TRAINING, TrackingState.TRACKING)),
        ("photos", [], (CameraOrigin.ASSUMED, TrackingState.LIMITED)),
        ("video", [SMALL], (CameraOrigin.TRAINING, TrackingState.TRACKING)),
    ],
)
def test_tracking_starts_at_the_training_view_that_it_is_told(
    scene: Path, sequence: str, known: list[Camera], expected: tuple[CameraOrigin, TrackingState]
) -> None:
    for i in range(3):
        Image.new("RGB", (32, 32)).save(scene / f"photo{i}.png")
    tracking = tracking_in(scene / "field", guess="train:r_2", sequence=sequence)
    messages = run_through(tracking, CameraConfig(f"folder:{scene}"), *known)
    guesses = [message for message in messages if isinstance(message, Guess)]
    later = GuessReason.PRIOR if sequence == "photos" else GuessReason.MOTION
    assert [guess.reason for guess in guesses] == [GuessReason.PRIOR, later, later]
    start = training_views(load_field(scene / "field")).cam_from_object[2]
    np.testing.assert_array_equal(guesses[0].cam_from_object, start)
    assert not any(isinstance(message, Truth) for message in messages)
    states = [(message.camera_origin, message.state) for message in messages if isinstance(message, State)]
    assert states == [expected] * 3


def test_a_bad_field_or_guess_is_refused_at_start(scene: Path) -> None:
    with pytest.raises(FieldFileError):
        tracking_in(scene / "none").start()
    with pytest.raises(ConfigError):
        tracking_in(scene / "field", guess="nowhere.json").start()


def test_frames_skipped_by_the_bus_are_counted_at_the_door(scene: Path) -> None:
    node = started(scene / "field", depth=4)
    for sequence in (0, 3):
        (guess,) = told(node, CAMERA_INFO, info(sequence, sequence))
    assert isinstance(guess, Guess)
    (state,) = told(node, POSE, answer(guess))
    assert isinstance(state, State)
    assert (state.admitted, state.dropped_at_the_door) == (2, 2)


def test_the_guess_tells_the_camera_of_its_frame(scene: Path) -> None:
    wide = Camera(64, 32, 40.0, 41.0, 30.0, 15.0, (0.1, 0.0, 0.0, 0.0, 0.0))
    node = started(scene / "field", guess="train:r_0")
    (guess,) = told(node, CAMERA_INFO, info(3, camera=wide))
    assert isinstance(guess, Guess)
    assert guess.camera == wide
    assert (guess.header.frame_id, guess.header.capture_ns, guess.header.pass_index) == (3, 5, 0)


@pytest.mark.parametrize("sequence", ["photos", "video"])
def test_what_looks_like_a_frame_is_asked_before_anything_is_rendered(scene: Path, sequence: str) -> None:
    node = started(scene / "field", looks=True, sequence=sequence)
    (search,) = told(node, CAMERA_INFO, info(4))
    assert isinstance(search, Search)
    assert search.header.frame_id == 4
    best, other = on_sphere(77, 20), on_sphere(-60, 50)
    (guess,) = told(node, RETRIEVED, retrieved(search, best, other))
    assert isinstance(guess, Guess)
    assert (guess.reason, guess.header.pass_index) == (GuessReason.RELOCALISATION, 0)
    np.testing.assert_array_equal(guess.cam_from_object, best)
    assert told(node, RETRIEVED, retrieved(search, other)) == []
    (again,) = told(node, FAILURE, failure(guess))
    assert isinstance(again, Guess)
    assert (again.header.frame_id, again.header.pass_index) == (4, 1)
    if sequence == "photos":
        np.testing.assert_array_equal(again.cam_from_object, other)


def test_a_failure_of_retrieval_answers_a_search_and_one_of_another_stage_a_pass(scene: Path) -> None:
    node = started(scene / "field", looks=True, sequence="photos", searches=0)
    (search,) = told(node, CAMERA_INFO, info())
    assert told(node, FAILURE, failure(search, "pnp")) == []
    (guess,) = told(node, FAILURE, failure(search, "retrieval", Reason.NOT_AVAILABLE))
    assert isinstance(guess, Guess)
    assert told(node, FAILURE, failure(search, "retrieval")) == []
    (state,) = told(node, FAILURE, failure(guess, "matching", Reason.TOO_FEW_MATCHES))
    assert isinstance(state, State)
    assert (state.state, state.reason, state.finished) == (TrackingState.LOST, Reason.TOO_FEW_MATCHES, 1)


def test_a_photo_that_nothing_looks_like_is_lost_for_that_reason(scene: Path) -> None:
    node = started(scene / "field", looks=True, sequence="photos")
    (search,) = told(node, CAMERA_INFO, info())
    (state,) = told(node, FAILURE, failure(search, "retrieval", Reason.NOTHING_ALIKE))
    assert isinstance(state, State)
    assert (state.state, state.reason) == (TrackingState.LOST, Reason.NOTHING_ALIKE)
    assert state.cam_from_object is None


@pytest.mark.parametrize("before", [True, False], ids=["before its frame", "after its frame"])
def test_a_prior_may_come_before_its_frame_or_after(scene: Path, before: bool) -> None:
    node = started(scene / "field", guess="perturb:10-40deg,0.2")
    prior = Prior(header=first_header(6, 5), cam_from_object=on_sphere(10, 20))
    messages = [(PRIOR, prior), (CAMERA_INFO, info(6))]
    first, second = messages if before else messages[::-1]
    assert told(node, *first) == []
    (guess,) = told(node, *second)
    assert isinstance(guess, Guess)
    assert (guess.reason, guess.header.frame_id) == (GuessReason.PRIOR, 6)
    np.testing.assert_array_equal(guess.cam_from_object, prior.cam_from_object)


def test_a_frame_whose_prior_does_not_come_is_reported(scene: Path) -> None:
    node = started(scene / "field", guess="perturb:10-40deg,0.2", guess_wait_ms=500.0)
    began_ns = time.time_ns()
    assert told(node, CAMERA_INFO, info(6)) == []
    ((topic, state),) = node.tick(began_ns + 10_000_000_000)
    assert topic is STATE
    assert isinstance(state, State)
    assert (state.header.frame_id, state.state, state.reason) == (6, TrackingState.LOST, Reason.NO_GUESS)


def test_an_assumed_camera_makes_no_pose_certain(scene: Path) -> None:
    states = []
    for origin in (CameraOrigin.TRAINING, CameraOrigin.ASSUMED):
        node = started(scene / "field", guess="train:r_1")
        (guess,) = told(node, CAMERA_INFO, info(origin=origin))
        assert isinstance(guess, Guess)
        (state,) = told(node, POSE, answer(guess))
        assert isinstance(state, State)
        states.append(state)
    trained, assumed = states
    assert [state.state for state in states] == [TrackingState.TRACKING, TrackingState.LIMITED]
    assert [state.camera_origin for state in states] == [CameraOrigin.TRAINING, CameraOrigin.ASSUMED]
    assert assumed.score <= 0.3 < trained.score
    assert (np.diag(assumed.covariance) > np.diag(trained.covariance)).all()
    np.testing.assert_array_equal(assumed.cam_from_object, trained.cam_from_object)


def test_messages_that_are_none_of_trackings_are_refused(scene: Path) -> None:
    node = started(scene / "field")
    frame = Frame(header=first_header(0, 0), image=np.zeros((32, 32, 3), np.uint8), encoding="rgb8", camera=SMALL)
    with pytest.raises(TypeError, match="Frame"):
        list(node.handle(FRAME, frame))


def test_a_pose_that_is_no_rigid_transform_is_a_failure() -> None:
    good = Guess(header=first_header(0, 0), reason=GuessReason.PRIOR, cam_from_object=np.eye(4), camera=SMALL)
    right = pose_result(answer(good))
    assert (right.reason, right.inliers) == (None, 100)
    np.testing.assert_array_equal(right.cam_from_object, np.eye(4))
    sheared = np.eye(4)
    sheared[0, 1] = 0.5
    bad = pose_result(answer(msgspec.structs.replace(good, cam_from_object=sheared)))
    assert (bad.cam_from_object, bad.reason) == (None, Reason.IMPLAUSIBLE_POSE)
