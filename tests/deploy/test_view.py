"""`fieldpose view`: what is put together of frames, drawn, and shown by a real browser, live and of a recording."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import threading
from collections.abc import Iterator
from itertools import cycle
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from support import bus_samples
from support.browser import PHONE, Browser, needs_browser
from support.commands import command, fieldpose

import fieldpose as fieldpose_api
from fieldpose.bus.messages import CameraInfo, Followed, Frame, Reason, State, TrackingState
from fieldpose.bus.ports import first_header
from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.topics import FRAME, STATE
from fieldpose.deploy.cli import main
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.viewing.drawing import FOUND_RGB, LOST_RGB, OVERLAYS, drawn
from fieldpose.deploy.viewing.moments import Moments, told
from fieldpose.deploy.viewing.recorded import RecordedMoments
from fieldpose.deploy.viewing.scene import ellipsoid, up_direction
from fieldpose.errors import UsageError
from fieldpose.stages.geometry import camera_centre, exp_se3
from fieldpose.stages.nerf.field import load_field, load_metadata
from fieldpose.stages.nerf.loading import load_renderer

ENOUGH_S = 20.0
SAID = "(document.body?.innerText ?? '')"


def state(frame_id: int, score: float = 0.9, reason: Reason | None = None) -> State:
    return State(
        header=first_header(frame_id, 1000 + frame_id), state=TrackingState.TRACKING, score=score,
        cam_from_object=exp_se3(np.array([frame_id, 0, 4, 0, 0, 0], float)), covariance=1e-4 * np.eye(6),
        reason=reason, in_flight=0, admitted=1, finished=1, dropped_at_the_door=3, lost=0,
    )  # fmt: skip


def followed(frame_id: int, found: list[bool]) -> Followed:
    return Followed(
        header=first_header(frame_id, 1000 + frame_id), cam_from_object=np.eye(4), covariance=np.eye(6),
        pixels_in_frame=np.zeros((len(found), 2), np.float32), found=np.array(found), residual_px=0.5, level=0,
    )  # fmt: skip


def test_what_is_said_of_a_frame_is_put_together() -> None:
    moments = Moments()
    assert moments.newest() is None
    for frame_id in range(3):
        moments.note(bus_samples.frame(frame_id))
    moments.note(state(0))
    moments.note(state(1, score=0.0))
    newest = moments.newest()
    assert newest is not None
    assert (newest.frame_id, newest.pose) == (1, None)
    assert newest.frame is not None
    assert [place[0] for place, _ in moments.way] == [pytest.approx(camera_centre(state(0).cam_from_object)[0])]
    moments.note(state(2))
    assert len(moments.way) == 2
    assert [moment.frame_id for moment in moments.answered()] == [0, 1, 2]


def test_images_of_old_frames_are_let_go_and_old_frames_too() -> None:
    moments = Moments(kept=20)
    for frame_id in range(50):
        moments.note(bus_samples.frame(frame_id))
        moments.note(state(frame_id))
    kept = list(moments.answered())
    assert [moment.frame_id for moment in kept] == list(range(30, 50))
    assert [moment.frame_id for moment in kept if moment.frame is not None] == list(range(42, 50))


def sent(message: Any, sequence: int) -> Any:
    message.header = msgspec.structs.replace(message.header, sequence=sequence)
    return message


def test_the_image_of_a_frame_that_is_being_solved_waits_for_its_state() -> None:
    """Where every frame is solved, states come long after newer frames have."""
    moments = Moments()
    for frame_id in range(50):
        moments.note(bus_samples.frame(frame_id))
        if frame_id == 3:
            moments.note_solving(bus_samples.frame(frame_id).header)
    moments.note(state(3))
    newest = moments.newest()
    assert newest is not None
    assert newest.frame_id == 3


def test_a_camera_that_begins_again_with_the_same_numbers_and_times_is_shown_anew() -> None:
    moments = Moments()
    for round_ in range(2):
        for frame_id in range(20):
            frame = bus_samples.frame(frame_id)
            moments.note(sent(CameraInfo(header=frame.header, camera=frame.camera), frame_id))
            moments.note(sent(frame, frame_id))
            moments.note(sent(state(frame_id), frame_id))
            newest = moments.newest()
            assert newest is not None
            assert (newest.frame_id, len(moments.way)) == (frame_id, frame_id + 1), round_


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (followed(0, [True] * 16 + [False] * 74), "16 of 90 points found: occluded, blurred, or out of view"),
        (followed(0, [True] * 80 + [False] * 10), "80 of 90 points found"),
        (state(0, reason=Reason.CAMERA_DIFFERS), "the focal length is not as it is said to be"),
        (state(0, reason=Reason.INTERNAL_ERROR), "internal error"),
    ],
)
def test_what_is_lost_is_said_in_words(message: Followed | State, words: str) -> None:
    moments = Moments()
    moments.note(state(0))
    moments.note(message)
    newest = moments.newest(with_image=False)
    assert newest is not None
    assert words in told(newest)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    path = folder / "run.mcap"
    sequence, field = demo_file("sequence.mcap"), demo_file("field.safetensors")
    ran = fieldpose("run", field, "--source", f"mcap:{sequence}", "--record", path, cwd=folder, timeout_s=120)
    assert ran.returncode == 0, ran.stderr
    return path


def test_a_recording_is_shown_frame_by_frame(recording: Path) -> None:
    moments = RecordedMoments(recording)
    assert len(moments) > 200
    renderer = load_renderer(demo_file("field.safetensors"))
    middle = len(moments) // 2
    moment = moments.at(middle)
    assert moment.pose is not None
    assert moment.frame is not None
    assert moment.frame.header.frame_id == moment.frame_id
    assert moment.lifted is not None
    assert 0.3 * middle < len(moments.way(middle)) <= middle + 1
    assert len(moments.way(0)) <= 1
    assert moments.after(middle, 0.001) == middle + 1
    assert moments.seconds[moments.after(middle, 1.0)] == pytest.approx(moments.seconds[middle] + 1, abs=0.1)
    assert moments.after(len(moments) - 1, 1.0) == 0
    plain = drawn(moment, renderer, "none", points=False)
    assert plain is not None
    for overlay in OVERLAYS[:-1]:
        over = drawn(moment, renderer, overlay, points=False)
        assert over is not None
        assert (over != plain).any(axis=-1).mean() > 0.01
    dotted = drawn(moment, None, "edges", points=True)
    assert dotted is not None
    changed = dotted[(dotted != plain).any(axis=-1)].astype(int)
    colours = (FOUND_RGB, LOST_RGB)
    assert any((np.abs(changed - colour).max(axis=-1) < 40).any() for colour in colours)
    with pytest.raises(UsageError, match="choose one with --pipeline"):
        RecordedMoments(recording, "nobody/nowhere")


def serving(*arguments: object, folder: Path) -> tuple[subprocess.Popen[str], str]:
    """A viewer and the address that it prints."""
    process = subprocess.Popen(
        command("view", *arguments), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    for line in process.stdout:
        found = re.search(r"http://127\.0\.0\.1:\d+", line)
        if found:
            return process, found.group()
    raise AssertionError(f"ended with {process.wait(10)}")


@pytest.fixture
def ended() -> Iterator[list[subprocess.Popen[str]]]:
    processes: list[subprocess.Popen[str]] = []
    yield processes
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0


@needs_browser
def test_a_browser_shows_a_recording(recording: Path, tmp_path: Path, ended: list[subprocess.Popen[str]]) -> None:
    process, url = serving(recording, folder=tmp_path)
    ended.append(process)
    with Browser(url, tmp_path / "profile") as browser:
        browser.wait_for(f"{SAID}.includes('frame 0')")
        assert browser.ask("document.querySelectorAll('canvas').length") > 0
        assert browser.wait_for("[...document.images].some((image) => image.naturalWidth > 300)")
        said = browser.ask(SAID)
        for words in ("followed, found", "latency", "training cameras", "score"):
            assert words in said
        # Everything comes from this machine.
        loaded = "performance.getEntriesByType('resource').map((entry) => entry.name)"
        assert all(name.startswith((url, "data:", "blob:")) for name in browser.ask(loaded))
        browser.picture(tmp_path / "page.png")
    assert (tmp_path / "page.png").stat().st_size > 50_000


BUTTON = "[...document.querySelectorAll('button')].find((each) => each.innerText == '{}')"
WIDEST = "Math.max(...[...document.querySelectorAll('body *')].map((each) => each.getBoundingClientRect().right))"


@needs_browser
def test_a_recording_on_a_phone(recording: Path, tmp_path: Path, ended: list[subprocess.Popen[str]]) -> None:
    process, url = serving(recording, folder=tmp_path)
    ended.append(process)
    with Browser(url, tmp_path / "profile", phone=True) as browser:
        browser.wait_for(f"{SAID}.includes('frame 0')")
        # As wide as the screen allows, and nothing beyond it.
        shown = "[...document.images].filter((image) => image.naturalWidth > 300)"
        browser.wait_for(f"{shown}.some((image) => image.getBoundingClientRect().width > 0.9 * {PHONE[0]})")
        assert browser.ask(WIDEST) <= PHONE[0]
        said = browser.ask(SAID)
        for words in ("play", "each stage of a solve", "rendering", "camera frames", "dropped at the door"):
            assert words in said
        assert browser.ask("Object.keys(window.__viserTestpoints.uplots).length") == 5
        # A touch on the title folds what hides the scene.
        assert browser.ask(f"document.elementFromPoint({PHONE[0] // 2}, {PHONE[1] // 2 + 50}).tagName") != "CANVAS"
        titles = f"[...document.querySelectorAll('div')].filter((each) => each.innerText == '{recording.name}')"
        browser.tap(f"{titles}.pop()")
        browser.wait_for(f"document.elementFromPoint({PHONE[0] // 2}, {PHONE[1] // 2 + 50}).tagName == 'CANVAS'")


def sent_again_and_again(hub: str, stop: threading.Event) -> None:
    """The frames of the demo's sequence, there and back, until `stop`."""
    frames = [cast(Frame, each.message) for each in read_recording(demo_file("sequence.mcap"), (FRAME,))]
    with fieldpose_api.connect(hub, timeout_s=ENOUGH_S) as pipeline:
        for frame in cycle([*frames, *frames[-2:0:-1]]):
            if stop.wait(0.05):
                return
            pipeline.publish(frame.image, frame.camera, encoding=frame.encoding)


@needs_browser
def test_a_phone_shows_a_run_live_and_asks_something_of_it(tmp_path: Path) -> None:
    run = subprocess.Popen(
        command("run", demo_file("field.safetensors"), "--source", "bus", "--view", "--record.snapshots", "kept"),
        cwd=tmp_path,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    stop, sending = threading.Event(), None
    try:
        assert run.stdout is not None
        printed = ""
        while not ("http" in printed and "running" in printed):
            printed += run.stdout.readline()
        hub, url = (re.search(pattern, printed) for pattern in (r"hub (t\S+)", r"http://127[\d.]+:\d+"))
        assert hub is not None
        assert url is not None
        with Browser(url.group(), tmp_path / "profile", phone=True) as browser:
            browser.wait_for(f"{SAID}.includes('object/camera0 is running; waiting for a frame')")
            sending = threading.Thread(target=sent_again_and_again, args=(hub.group(1), stop))
            sending.start()
            browser.wait_for(f"/tracking; \\d+ of \\d+ points found/.test({SAID})", 60)
            browser.tap(BUTTON.format("save the last 10 s"))
            browser.wait_for(f"{SAID}.includes('Saved ')")
            (saved,) = (tmp_path / "kept").glob("*.mcap")
            assert {FRAME.name, STATE.name} <= {topic.topic for topic in info(saved).topics}
            browser.tap(BUTTON.format("take a keyframe"))
            browser.wait_for(f"{SAID}.includes('view is kept')")
            browser.tap(BUTTON.format("begin again"))
            browser.wait_for(f"{SAID}.includes('Tracking begins again.')")
            browser.wait_for(f"/tracking; \\d+ of \\d+ points found/.test({SAID})", 60)
            browser.wait_for(f"{SAID}.includes('camera frames')")
            stop.set()
            browser.wait_for(f"{SAID}.includes('Nothing has come for')")
        run.send_signal(signal.SIGINT)
        out, _ = run.communicate(timeout=60)
        assert run.returncode == 0, out
    finally:
        stop.set()
        if sending is not None:
            sending.join()
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()


def test_a_field_in_another_frame_than_the_recorded_poses_is_refused(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field = load_field(demo_file("field.safetensors"))
    field.metadata = msgspec.structs.replace(
        field.metadata, frame=msgspec.structs.replace(field.metadata.frame, translation=(1.0, 0.0, 0.0))
    )
    field.save(tmp_path / "moved.safetensors")
    assert main(["view", str(recording), "--field", str(tmp_path / "moved.safetensors")]) == 2
    assert "its frame is another than that of the recorded poses" in one_line(capsys)


def test_points_that_are_nowhere_in_the_picture_are_left_out() -> None:
    pixels = np.array([[2, 1], [1e9, 1], [-1e9, 3], [3, 2]], np.float32)
    moments = Moments()
    moments.note(bus_samples.frame(0))
    message = followed(0, [True] * 4)
    message.pixels_in_frame = pixels
    moments.note(message)
    moments.note(state(0))
    newest = moments.newest()
    assert newest is not None
    assert drawn(newest, None, "none", points=True) is not None


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_what_cannot_be_shown_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path / "no.mcap")]) == 2
    assert "cannot be read" in capsys.readouterr().err
    for name in ("run.mcap.partial", "run.mcap.partial.before"):
        assert main(["view", str(tmp_path / name)]) == 2
        assert f"`fieldpose recover {tmp_path}/{name} --out {tmp_path}/run.mcap` mends it" in one_line(capsys)
    assert main(["view", str(demo_file("sequence.mcap"))]) == 2
    assert "holds no field" in one_line(capsys)
    assert main(["view", str(demo_file("sequence.mcap")), "--field", str(demo_file("field.safetensors"))]) == 2
    assert "holds no states of tracking, so nothing to look at" in one_line(capsys)
    assert main(["view", str(demo_file("field.safetensors")), "--port", "0"]) == 2
    assert "expected 1 to 65535" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("ups", "expected"),
    [
        ([], (0, 0, 1)),
        ([(0, 1, 0), (0.3, 1, 0), (-0.3, 1, 0.2)], (0, 1, 0)),
        ([(0, 0, -1)], (0, 0, -1)),
        ([(1, 1, 1)], (3**-0.5, 3**-0.5, 3**-0.5)),
        ([(1, 0, 0), (-1, 0, 0)], (0, 0, 1)),
    ],
)
def test_the_scene_stands_as_the_cameras_were_held(ups: list[Any], expected: tuple[float, ...]) -> None:
    metadata = load_metadata(demo_file("field.safetensors"))
    cameras = []
    for up in np.array(ups, float).reshape(-1, 3):
        pose = np.eye(4)
        pose[1, :3] = -up / np.linalg.norm(up)
        pose[0, :3] = np.cross(pose[1, :3], np.roll(pose[1, :3], 1) + np.array([0.1, 0.2, 0.4]))
        pose[0, :3] /= np.linalg.norm(pose[0, :3])
        pose[2, :3] = np.cross(pose[0, :3], pose[1, :3])
        cameras.append(msgspec.structs.replace(metadata.cameras[0], cam_from_object=tuple(pose.ravel().tolist())))
    held = up_direction(msgspec.structs.replace(metadata, cameras=cameras))
    np.testing.assert_allclose(held, expected, atol=1e-9)


def test_the_ellipsoid_is_where_the_camera_may_be() -> None:
    """By drawing twists: those of two standard deviations along the longest axis reach its end."""
    rng = np.random.default_rng(0)
    pose = exp_se3(np.array([0.3, -0.2, 4.0, 0.5, -1.0, 0.2]))
    covariance = np.diag([0.01, 0.04, 0.09, 1e-6, 1e-6, 1e-6])
    vertices, triangles = ellipsoid(pose, covariance, 2.0)
    drawn_twists = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    centres = np.stack([camera_centre(exp_se3(twist) @ pose) for twist in drawn_twists])
    np.testing.assert_allclose(vertices.mean(axis=0), camera_centre(pose), atol=0.02)
    for axis in np.linalg.eigh(np.cov(centres.T))[1].T:
        reach = np.abs((vertices - camera_centre(pose)) @ axis).max()
        assert reach == pytest.approx(2 * ((centres - centres.mean(axis=0)) @ axis).std(), rel=0.1)
    assert triangles.max() == len(vertices) - 1
