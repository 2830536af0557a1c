"""The camera node: what it sends, how it goes on after a kill, and how it ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.posed_images import CAMERA, write_blender

from fieldpose.bus.messages import (
    CameraInfo,
    CameraOrigin,
    Failure,
    Frame,
    Message,
    Reason,
    State,
    TrackingState,
    Truth,
)
from fieldpose.bus.node import TICK_S, EndOfInput, KeepsTime, first_header
from fieldpose.bus.topics import CAMERA_INFO, FAILURE, FRAME, STATE, TRUTH
from fieldpose.errors import SourceError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.node import CameraNode
from fieldpose.stages.geometry import Camera


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "photos"
    root.mkdir()
    for i in range(3):
        Image.fromarray(np.full((8, 12, 3), 10 * i, np.uint8)).save(root / f"{i}.png")
    return root


def started(folder: Path, **config: object) -> CameraNode:
    node = CameraNode(CameraConfig(f"folder:{folder}", **config))  # type: ignore[arg-type]
    node.start()
    return node


def all_sent(node: CameraNode, now_ns: int = 10**18) -> list[Message]:
    """What a tick sends until the node ends; each on its own topic."""
    messages = []
    try:
        for topic, message in node.tick(now_ns):
            assert topic in node.outputs
            assert isinstance(message, topic.message_type)
            messages.append(message)
    except EndOfInput:
        pass
    return messages


def sent(node: CameraNode, now_ns: int = 10**18) -> list[Frame]:
    """The frames among them."""
    return [message for message in all_sent(node, now_ns) if isinstance(message, Frame)]


def answer(frame_id: int) -> State:
    return State(
        header=first_header(frame_id, 0),
        state=TrackingState.TRACKING,
        score=1.0,
        cam_from_object=None,
        covariance=None,
        in_flight=0,
        admitted=1,
        finished=1,
        dropped_at_the_door=0,
        lost=0,
    )


def test_an_answer_brings_the_next_frame_at_once_and_the_last_one_the_end(folder: Path) -> None:
    node = started(folder)
    assert [frame.header.frame_id for frame in sent(node)] == [0]
    assert sent(node) == []
    for i in (1, 2):
        said = list(node.handle(STATE, answer(i - 1)))
        assert [topic for topic, _ in said] == [FRAME, CAMERA_INFO]
        assert [message.header.frame_id for _, message in said] == [i, i]
    with pytest.raises(EndOfInput):
        list(node.handle(STATE, answer(2)))
    node.stop()


def test_frames_carry_image_camera_and_the_time_of_capture(folder: Path) -> None:
    frame = sent(started(folder), now_ns=123_456)[0]
    np.testing.assert_array_equal(frame.image, np.zeros((8, 12, 3)))
    assert (frame.camera.width, frame.camera.height, frame.camera.cx) == (12, 8, 5.5)
    assert frame.header.capture_ns == 123_456


def test_after_a_frame_comes_what_it_is_without_its_pixels(folder: Path) -> None:
    frame, info = all_sent(started(folder), now_ns=123_456)
    assert isinstance(frame, Frame)
    assert isinstance(info, CameraInfo)
    assert (info.header, info.camera, info.camera_origin) == (frame.header, frame.camera, frame.camera_origin)


def test_a_known_truth_comes_before_its_frame(tmp_path: Path) -> None:
    poses = write_blender(tmp_path, CAMERA.resized(16, 16), counts=(2, 2))
    node = CameraNode(CameraConfig(f"dataset:{tmp_path}:test", pace="fast"))
    node.start()
    messages = all_sent(node)
    assert [type(message) for message in messages] == [Truth, Frame, CameraInfo] * 2
    assert [message.header.frame_id for message in messages] == [0, 0, 0, 1, 1, 1]
    for truth, pose in zip(messages[::3], poses[2:], strict=True):
        assert isinstance(truth, Truth)
        np.testing.assert_allclose(truth.cam_from_object, pose, atol=1e-6)
    assert TRUTH in node.outputs


@pytest.mark.parametrize(
    ("known", "origin", "focal"),
    [
        ([Camera(24, 16, 30.0, 30.0, 11.5, 7.5)], CameraOrigin.TRAINING, 15.0),
        ([Camera(16, 16, 30.0, 30.0, 7.5, 7.5)], CameraOrigin.ASSUMED, 6 / np.tan(np.pi / 6)),
        ([], CameraOrigin.ASSUMED, 6 / np.tan(np.pi / 6)),
    ],
    ids=["known", "another shape", "unknown"],
)
def test_frames_and_what_is_told_of_them_tell_where_their_camera_is_from(
    folder: Path, known: list[Camera], origin: CameraOrigin, focal: float
) -> None:
    node = CameraNode(CameraConfig(f"folder:{folder}", pace="fast"), lambda: known)
    node.start()
    messages = all_sent(node)
    assert len(messages) == 6
    for message in messages:
        assert isinstance(message, Frame | CameraInfo)
        assert message.camera_origin is origin
        assert message.camera.fx == pytest.approx(focal)


def test_the_training_cameras_are_not_asked_for_before_the_start(folder: Path) -> None:
    calls: list[str] = []

    def known() -> list[Camera]:
        calls.append("asked")
        return []

    node = CameraNode(CameraConfig(f"folder:{folder}"), known, lambda: calls.append("waited"))
    assert calls == []
    node.start()
    assert calls == ["asked", "waited"]
    node.stop()


def test_a_failure_is_a_sign_of_life_but_no_answer(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    second = 1_000_000_000
    node = started(folder, answer_timeout_s=1.0)
    assert FAILURE in node.inputs
    assert [frame.header.frame_id for frame in sent(node, now_ns=0)] == [0]
    failure = Failure(header=first_header(0, 0), stage="pnp", reason=Reason.NO_CONSENSUS)
    monkeypatch.setattr("fieldpose.stages.camera.node.time.time_ns", lambda: second // 2)
    assert list(node.handle(FAILURE, failure)) == []
    assert sent(node, now_ns=second + second // 4) == []
    assert [frame.header.frame_id for frame in sent(node, now_ns=2 * second)] == [1]


def test_it_asks_to_be_called_when_the_next_frame_is_due(folder: Path) -> None:
    """And every 20 ms where it is not known when that is."""
    node, start_ns, ms = started(folder, pace="live", rate_hz=10), 10**18, 1_000_000
    assert isinstance(node, KeepsTime)
    assert node.tick_in_s(start_ns) == TICK_S
    assert [frame.header.frame_id for frame in sent(node, start_ns)] == [0]
    assert node.tick_in_s(start_ns) == pytest.approx(0.1)
    assert node.tick_in_s(start_ns + 97 * ms) == pytest.approx(0.003)
    assert sent(node, start_ns + 99 * ms) == []
    assert [frame.header.frame_id for frame in sent(node, start_ns + 100 * ms)] == [1]
    assert [frame.header.frame_id for frame in sent(node, start_ns + 200 * ms)] == [2]
    assert node.tick_in_s(start_ns + 200 * ms) == TICK_S


def test_photos_that_wait_for_answers_are_looked_after_every_20_ms(folder: Path) -> None:
    node = started(folder)
    assert len(sent(node)) == 1
    assert node.tick_in_s(10**18) == TICK_S


def test_a_camera_that_died_goes_on_with_the_next_frame(folder: Path, tmp_path: Path) -> None:
    progress = tmp_path / "progress.json"
    assert [frame.header.frame_id for frame in sent(started(folder, progress_file=progress))] == [0]
    again = started(folder, progress_file=progress, pace="fast")
    assert [frame.header.frame_id for frame in sent(again)] == [1, 2]


def test_a_source_that_breaks_on_the_way_ends_the_process_with_its_error(folder: Path) -> None:
    node = started(folder, pace="fast")
    (folder / "1.png").write_text("no longer an image")
    assert [frame.header.frame_id for frame in sent(node)] == [0]
    with pytest.raises(SourceError, match=r"1\.png"):
        node.stop()


def test_nothing_is_sent_before_the_others_are_ready(folder: Path) -> None:
    calls = []
    node = CameraNode(CameraConfig(f"folder:{folder}"), wait_until_ready=lambda: calls.append("waited"))
    assert calls == []
    node.start()
    assert calls == ["waited"]
    node.stop()


def test_stopping_before_the_start_is_no_error(folder: Path) -> None:
    CameraNode(CameraConfig(f"folder:{folder}")).stop()
