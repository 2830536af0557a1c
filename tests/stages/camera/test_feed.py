"""When each frame is sent: by its own time, by the answers, or at once; and when all is over."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fieldpose.bus.topics import FRAME
from fieldpose.errors import ConfigError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame, Clock, Feed, Source
from fieldpose.stages.camera.progress import Progress
from fieldpose.stages.camera.sender import Sender
from fieldpose.stages.geometry import Camera

MS = 1_000_000
START = 1_700_000_000_000 * MS
TIMES_MS = (500, 533, 567, 700, 733)


def source(clock: Clock, count: int = 5) -> Source:
    def frames(first: int) -> Iterator[CapturedFrame]:
        for i in range(first, count):
            at_ns = None if clock == "none" else (START if clock == "wall" else 0) + TIMES_MS[i % 5] * MS
            yield CapturedFrame(
                i, np.zeros((2, 2, 3), np.uint8), "rgb8", Camera(2, 2, 1.0, 1.0, 0.5, 0.5), str(i), at_ns
            )

    return Source("test", clock, frames, count)


def feed(clock: Clock, count: int = 5, first: int = 0, **config: object) -> Feed:
    return Feed(source(clock, count), CameraConfig("folder:x", **config), first)  # type: ignore[arg-type]


def sent(feed: Feed, at_ms: float) -> list[tuple[int, float]]:
    """(frame_id, capture time in ms since START) of what is sent at that time."""
    return [(f.frame_id, (ns - START) / MS) for f, ns in feed.due(START + int(at_ms * MS))]


def test_live_frames_go_when_their_own_times_say_so() -> None:
    live = feed("own")
    assert sent(live, 0) == [(0, 0)]
    assert sent(live, 32) == []
    assert sent(live, 70) == [(1, 33), (2, 67)]
    assert sent(live, 199) == []
    assert sent(live, 1000) == [(3, 200), (4, 233)]


def test_after_a_pause_live_frames_go_on_at_their_pace_and_not_in_a_rush() -> None:
    late = feed("own")
    sent(late, 0)
    assert sent(late, 1000) == [(1, 33), (2, 67), (3, 200), (4, 233)]
    assert late.held_up_ns == 0
    halted = feed("own")
    sent(halted, 0)
    assert sent(halted, 5000) == [(1, 5000)]
    assert sent(halted, 5033) == []
    assert sent(halted, 5034) == [(2, 5034)]
    assert halted.held_up_ns == (5000 - 33) * MS
    in_step = feed("own", pace="lockstep")
    sent(in_step, 0)
    in_step.answered(0, 0, 0)
    sent(in_step, 5000)
    assert in_step.held_up_ns == 0


def test_a_clock_that_is_set_back_stops_no_film() -> None:
    live = feed("own")
    sent(live, 0)
    assert sent(live, 33) == [(1, 33)]
    assert sent(live, -3600_000) == []
    assert sent(live, -3600_000 + 33) == []
    assert sent(live, -3600_000 + 34) == [(2, -3600_000 + 34)]
    assert live.wait_s(START - 3600_000 * MS) == 0.134 + 0.033


def test_every_other_frame_goes_at_its_own_time_and_a_second_start_goes_on_there() -> None:
    every_other = feed("own", every=2)
    assert sent(every_other, 0) == [(0, 0)]
    assert sent(every_other, 1000) == [(2, 67), (4, 233)]
    assert [frame_id for frame_id, _ in sent(feed("none", every=2, first=1, pace="fast"), 0)] == [2, 4]


def test_how_long_it_is_until_the_next_live_frame_is_known_once_the_first_is_sent() -> None:
    live = feed("own")
    assert live.wait_s(START) is None
    assert sent(live, 0) == [(0, 0)]
    assert live.wait_s(START) == pytest.approx(0.033)
    assert live.wait_s(START + 30 * MS) == pytest.approx(0.003)
    assert live.wait_s(START + 40 * MS) == 0
    assert sent(live, 40) == [(1, 33)]
    assert live.wait_s(START + 40 * MS) == pytest.approx(0.027)
    assert sent(live, 1000) == [(2, 67), (3, 200), (4, 233)]
    assert live.wait_s(START + 1000 * MS) is None


def test_a_frame_that_is_waited_for_is_sent_when_it_is_due_and_once() -> None:
    live, now_ms, ids = feed("own"), 0.0, []
    for _ in range(5):
        ids += [frame_id for frame_id, _ in sent(live, now_ms)]
        now_ms += (live.wait_s(START + round(now_ms * MS)) or 0.0) * 1e3
    assert ids == [0, 1, 2, 3, 4]
    assert now_ms == pytest.approx(233)


@pytest.mark.parametrize(
    ("clock", "pace"), [("none", "lockstep"), ("none", "fast"), ("own", "fast"), ("own", "lockstep"), ("wall", "live")]
)
def test_where_frames_do_not_wait_for_their_time_there_is_none_to_wait(clock: Clock, pace: str) -> None:
    other = feed(clock, pace=pace)
    for now_ms in (0, 1, 500):
        sent(other, now_ms)
        assert other.wait_s(START + now_ms * MS) is None


def test_a_rate_replaces_the_times() -> None:
    assert [sent(feed_, 0) + sent(feed_, 99) + sent(feed_, 100) for feed_ in [feed("own", rate_hz=10)]] == [
        [(0, 0), (1, 100)]
    ]
    photos = feed("none", pace="live", rate_hz=4)
    assert sent(photos, 0) + sent(photos, 249) + sent(photos, 250) == [(0, 0), (1, 250)]


def test_photos_go_in_lockstep_with_the_answers_and_the_time_of_sending() -> None:
    photos = feed("none", count=3)
    assert sent(photos, 0) == [(0, 0)]
    assert sent(photos, 5000) == []
    photos.answered(0, 0, START + 6000 * MS)
    assert sent(photos, 6000) == [(1, 6000)]
    photos.answered(0, 0, START + 6100 * MS)
    assert sent(photos, 6200) == []


def test_a_frame_of_several_objects_is_answered_once_all_of_them_have_answered() -> None:
    photos = feed("none", count=2, objects=("lamp", "can"))
    assert sent(photos, 0) == [(0, 0)]
    photos.answered(0, 0, START, "lamp")
    photos.answered(0, 0, START, "lamp")
    assert sent(photos, 10) == []
    photos.answered(0, 0, START, "can")
    assert sent(photos, 20) == [(1, 20)]
    photos.answered(1, 0, START + 30 * MS, "can")
    photos.answered(1, 1, START + 30 * MS, "lamp")
    assert not photos.over(START + 40 * MS)
    photos.answered(0, 0, START + 50 * MS, "lamp")
    assert sent(photos, 50) == []
    assert photos.over(START + 50 * MS)


def test_a_video_in_lockstep_keeps_its_own_times() -> None:
    video = feed("own", pace="lockstep")
    captured = []
    for i in range(5):
        captured += sent(video, 1000 * i)
        video.answered(i, 0, START + 1000 * i * MS)
    assert captured == [(0, 0), (1, 33), (2, 67), (3, 200), (4, 233)]


def test_lockstep_goes_on_without_an_answer_once_there_is_no_sign_of_life() -> None:
    photos = feed("none", answer_timeout_s=1.0)
    assert sent(photos, 0) == [(0, 0)]
    photos.sign_of_life(0, START + 900 * MS)
    assert sent(photos, 1800) == []
    assert sent(photos, 1901) == [(1, 1901)]
    assert photos.unanswered == 1


def test_fast_sends_all_in_a_few_ticks() -> None:
    fast = feed("none", count=20, pace="fast")
    assert [len(sent(fast, i)) for i in range(4)] == [8, 8, 4, 0]


def test_a_device_sets_the_pace_and_the_times() -> None:
    device = feed("wall")
    assert sent(device, 0) == [(0, 500)]
    assert sent(device, 1) == [(1, 533)]
    with pytest.raises(ConfigError, match="does not wait"):
        feed("wall", pace="lockstep")


def test_it_is_over_when_the_last_frame_is_answered_and_none_is_in_flight() -> None:
    last = feed("none", count=2)
    for i in range(2):
        assert sent(last, 10 * i) == [(i, 10 * i)]
        assert not last.over(START + 10 * MS)
        last.answered(i, 1, START + 10 * i * MS)
    assert sent(last, 20) == []
    assert not last.over(START + 20 * MS)
    last.answered(0, 0, START + 20 * MS)
    assert last.over(START + 20 * MS)


def test_it_is_over_after_a_while_when_nobody_answers() -> None:
    alone = feed("own", answer_timeout_s=2.0)
    sent(alone, 0)
    sent(alone, 1000)
    assert sent(alone, 1001) == []
    assert not alone.over(START + 2999 * MS)
    assert alone.over(START + 3001 * MS)


def test_no_more_frames_than_asked_for_even_after_a_restart() -> None:
    few = feed("none", pace="fast", frames=3)
    assert [i for i, _ in sent(few, 0)] == [0, 1, 2]
    rest = feed("none", pace="fast", frames=3, first=2)
    assert [i for i, _ in sent(rest, 0)] == [2]


def test_a_restarted_source_goes_on_at_once_where_it_was() -> None:
    assert sent(feed("own", first=3), 0) == [(3, 0)]


def test_a_camera_goes_on_where_its_progress_cannot_be_noted(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for i in range(3):
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "images" / f"{i}.png")
    note = tmp_path / "gone" / "progress.json"
    sender = Sender(CameraConfig(f"folder:{tmp_path / 'images'}", pace="fast", progress_file=note))
    frames = [message.header.frame_id for topic, message in sender.messages(START) if topic is FRAME]
    assert frames == [0, 1, 2]
    sender.close()


def test_progress_survives_and_belongs_to_its_source(tmp_path: Path) -> None:
    path = tmp_path / "progress.json"
    progress = Progress(path, "video:a")
    for _ in range(3):
        progress.advance()
    assert Progress(path, "video:a").next == 3
    assert Progress(path, "video:b").next == 0
    path.write_text("{")
    assert Progress(path, "video:a").next == 0
    assert Progress(None, "video:a").next == 0
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("wrong", [{"size": 0}, {"rate_hz": -1.0}, {"frames": 0}, {"fov_deg": 180.0}])
def test_settings_out_of_range_are_refused_by_name(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        CameraConfig("folder:x", **wrong)  # type: ignore[arg-type]


def configured(clock: Clock, sent_before: int = 0, **config: object) -> Feed:
    return Feed(source(clock), CameraConfig("folder:x", **config), sent_before)  # type: ignore[arg-type]


def test_the_first_frames_are_left_out_and_a_second_start_goes_on_after_them() -> None:
    assert [frame_id for frame_id, _ in sent(configured("none", pace="fast", first=2), 0)] == [2, 3, 4]
    assert [frame_id for frame_id, _ in sent(configured("none", 1, pace="fast", first=2), 0)] == [3, 4]
    assert sent(configured("own", first=1), 0) == [(1, 0)]


def test_live_frames_go_so_many_times_as_fast() -> None:
    fast = configured("own", speed=2.0)
    assert sent(fast, 0) == [(0, 0)]
    assert sent(fast, 16) == []
    assert sent(fast, 40) == [(1, 16.5), (2, 33.5)]


@pytest.mark.parametrize(
    ("clock", "config", "said"),
    [
        ("wall", {"first": 1}, "a device has no frames to leave out"),
        ("wall", {"speed": 2.0}, "a device has no frames to leave out"),
        ("none", {"speed": 2.0}, "speed 2 is for pace live, and this pace is lockstep"),
        ("own", {"speed": 2.0, "pace": "fast"}, "this pace is fast"),
    ],
)
def test_what_a_source_cannot_do_is_refused(clock: Clock, config: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        configured(clock, **config)


@pytest.mark.parametrize("config", [{"first": -1}, {"speed": 0.0}])
def test_numbers_that_cannot_be_are_refused(config: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="must "):
        CameraConfig("folder:x", **config)  # type: ignore[arg-type]
