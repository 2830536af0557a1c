"""The camera node: what it sends, how it goes on after a kill, and how it ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fieldpose.bus.messages import Frame, State, TrackingState
from fieldpose.bus.node import EndOfInput, first_header
from fieldpose.bus.topics import STATE
from fieldpose.errors import SourceError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.node import CameraNode


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


def sent(node: CameraNode, now_ns: int = 10**18) -> list[Frame]:
    """What a tick sends until the node ends."""
    frames = []
    try:
        for _, message in node.tick(now_ns):
            assert isinstance(message, Frame)
            frames.append(message)
    except EndOfInput:
        pass
    return frames


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
        messages = [message for _, message in node.handle(STATE, answer(i - 1))]
        assert [message.header.frame_id for message in messages] == [i]
    with pytest.raises(EndOfInput):
        list(node.handle(STATE, answer(2)))
    node.stop()


def test_frames_carry_image_camera_and_the_time_of_capture(folder: Path) -> None:
    frame = sent(started(folder), now_ns=123_456)[0]
    np.testing.assert_array_equal(frame.image, np.zeros((8, 12, 3)))
    assert (frame.camera.width, frame.camera.height, frame.camera.cx) == (12, 8, 5.5)
    assert frame.header.capture_ns == 123_456


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
    node = CameraNode(CameraConfig(f"folder:{folder}"), lambda: calls.append("waited"))
    assert calls == []
    node.start()
    assert calls == ["waited"]
    node.stop()


def test_stopping_before_the_start_is_no_error(folder: Path) -> None:
    CameraNode(CameraConfig(f"folder:{folder}")).stop()
