"""Several processes of one stage: each pipeline is one's alone, and each message is answered once."""

from __future__ import annotations

import json
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.commands import command

from fieldpose.bus.messages import Guess, GuessReason
from fieldpose.bus.ports import Inbox, Outbox, first_header
from fieldpose.bus.topics import FAILURE, GUESS, VIEW, Address
from fieldpose.bus.transport import LOCAL_HUB, ZenohBus, wait_for
from fieldpose.deploy.cli import main
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.sharing import Share
from fieldpose.errors import UsageError
from fieldpose.stages.nerf.field import load_metadata

READY_S = 60.0
"""Kernels may have to be compiled."""
FRAMES = 10
LEFT, RIGHT = (Address("test", "lamp", camera) for camera in ("left", "right"))


@given(st.integers(1, 60), st.data())
def test_each_pipeline_is_one_workers_and_all_have_as_many(count: int, data: st.DataObject) -> None:
    of = data.draw(st.integers(1, count))
    shares = [Share(number, of).take(range(count)) for number in range(1, of + 1)]
    assert [one for share in shares for one in share] == list(range(count))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


@pytest.mark.parametrize("text", ["", "1", "0/2", "3/2", "1/0", "-1/2", "1/2/3", "a/b"])
def test_what_is_no_share_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="expected NUMBER/OF"):
        Share.parse(text)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["rendering", "--share", "1/2"], "--share is of the pipelines that --pipelines FILE lists, for retrieval"),
        (["tracking", "--share", "1/2", "--pipelines", "{file}"], "--share is of the pipelines"),
        (["rendering", "--share", "3/3", "--pipelines", "{file}"], "share 3/3: 2 pipelines cannot be shared by 3"),
        (["rendering", "--join", LOCAL_HUB], "--join is of the hub; rendering joins one by --connect"),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = pipelines(tmp_path)
    assert main(["stage", *(argument.format(file=file) for argument in arguments)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def pipelines(folder: Path) -> Path:
    """A list of two cameras' pipelines, by paths that count from its folder."""
    listed = []
    for at in (LEFT, RIGHT):
        settings = {"address": {"site": at.site, "object": at.object, "camera": at.camera}, "rendering": {"size": 48}}
        (folder / f"{at.camera}.json").write_text(json.dumps(settings))
        field = str(demo_file("field.safetensors"))
        listed.append({"settings": f"{at.camera}.json", "field": field, "processes": ["rendering"]})
    (folder / "pipelines.json").write_text(json.dumps({"pipelines": listed}))
    return folder / "pipelines.json"


@contextmanager
def hub(others: tuple[str, ...] = ()) -> Iterator[str]:
    """A hub in a process of its own."""
    address = f"tcp/127.0.0.1:{free_port()}"
    joins = [word for other in others for word in ("--join", other)]
    with ending(subprocess.Popen(command("stage", "hub", "--listen", address, "--open", *joins))):
        yield address


@contextmanager
def ending(process: subprocess.Popen[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    try:
        yield process
    finally:
        process.terminate()
        process.wait(READY_S)


def ask(outbox: Outbox, frames: range) -> None:
    camera = load_metadata(demo_file("field.safetensors")).cameras[0]
    pose = np.array(camera.cam_from_object).reshape(4, 4)
    for number in frames:
        header = first_header(number, 1000 + number)
        outbox.publish(
            GUESS, Guess(header=header, reason=GuessReason.PRIOR, cam_from_object=pose, camera=camera.camera)
        )


def answered(inbox: Inbox, wanted: int) -> Counter[tuple[str, int]]:
    """How often each guess was answered: by camera and number of the frame."""
    found: Counter[tuple[str, int]] = Counter()
    deadline = time.monotonic() + READY_S
    while sum(found.values()) < wanted and time.monotonic() < deadline:
        found.update(one_of(inbox, 0.1))
    found.update(one_of(inbox, 0.5))  # one too many would come now
    return found


def one_of(inbox: Inbox, timeout_s: float) -> list[tuple[str, int]]:
    received = inbox.get(timeout_s)
    if received is None:
        return []
    at = received.topic.address_of(received.key)
    assert at is not None
    return [(at.camera, received.message.header.frame_id)]


def test_two_rendering_processes_answer_each_guess_of_two_cameras_once_and_both_work(tmp_path: Path) -> None:
    file = pipelines(tmp_path)
    with hub() as address:
        shares = [
            command(
                "stage", "rendering", "--connect", address, "--open", "--pipelines", file, "--share", f"{number}/2",
                "--threads", 1,
            ) for number in (1, 2)
        ]  # fmt: skip
        bus = ZenohBus(address)
        with ending(subprocess.Popen(shares[0])), ending(subprocess.Popen(shares[1])) as second:
            inbox = Inbox(bus, replace(LEFT, camera="*"), [VIEW, FAILURE], {VIEW: 4 * FRAMES})
            wait_for(bus, LEFT, ["rendering", f"{RIGHT.pair}/rendering"], READY_S)
            to_left, to_right = (Outbox(bus, at, "tracking") for at in (LEFT, RIGHT))
            for number in range(FRAMES):
                for outbox in (to_left, to_right):
                    ask(outbox, range(number, number + 1))
            every = {(at.camera, number) for at in (LEFT, RIGHT) for number in range(FRAMES)}
            assert answered(inbox, 2 * FRAMES) == Counter(every)

            second.terminate()
            second.wait(READY_S)
            until(lambda: bus.live(RIGHT.live("rendering")) == set())
            for outbox in (to_left, to_right):
                ask(outbox, range(FRAMES, FRAMES + 2))
            assert answered(inbox, 2) == Counter({("left", FRAMES): 1, ("left", FRAMES + 1): 1})
            inbox.close()
        bus.close()


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + READY_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_hubs_that_are_joined_pass_messages_between_those_who_joined_each() -> None:
    with hub() as first, hub((first,)) as second:
        near, far = ZenohBus(first), ZenohBus(second)
        near.wait_for_hub(READY_S)
        far.wait_for_hub(READY_S)
        inbox, outbox = Inbox(far, LEFT, [GUESS]), Outbox(near, LEFT, "tracking")
        deadline = time.monotonic() + READY_S
        while inbox.get(0.05) is None:
            assert time.monotonic() < deadline
            ask(outbox, range(1))
        while inbox.get(0.5) is not None:
            pass
        ask(outbox, range(FRAMES))
        received = [inbox.get(READY_S) for _ in range(FRAMES)]
        assert [one.message.header.frame_id for one in received if one is not None] == list(range(FRAMES))
        inbox.close()
        near.close()
        far.close()
