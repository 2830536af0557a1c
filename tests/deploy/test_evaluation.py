"""Pairs are drawn as published, scores are what they say, and the command runs over the demo scene."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldpose.bus.messages import Reason
from fieldpose.deploy.cli import main
from fieldpose.deploy.evaluation.methods import Method
from fieldpose.deploy.evaluation.pairs import PROTOCOLS, Pair, draw
from fieldpose.deploy.evaluation.running import Examination
from fieldpose.deploy.evaluation.scores import Answer, curve, difference, score, share_of_solvable
from fieldpose.deploy.evaluation.words import in_short
from fieldpose.deploy.local import PoseFound
from fieldpose.deploy.scene import demo_file
from fieldpose.stages.geometry import camera_centre, exp_se3, look_at, rotation_about

TRUTHS = [look_at((4 * np.cos(a), 4 * np.sin(a), 1.0), (0, 0, 0), (0, 0, 1)) for a in np.arange(7.0)]

PAIR = Pair(0, 0, np.eye(4), np.eye(4))


def answer(re_deg: float | None, te: float = 0.0, seconds: float = 1.0, pair: Pair = PAIR) -> Answer:
    """One whose errors are known; no pose where the rotation is None."""
    if re_deg is None:
        return Answer(pair, None, None, seconds)
    pose = rotation_about((0, 0, 1), np.deg2rad(re_deg))
    pose[0, 3] = te
    return Answer(pair, pose, None, seconds)


def test_the_same_seed_draws_the_same_pairs_within_the_protocols_limits() -> None:
    protocol = PROTOCOLS["nerf-synthetic"]
    pairs, again = draw(protocol, TRUTHS, (0, 1)), draw(protocol, TRUTHS, (0, 1))
    assert len(pairs) == 50
    for one, other in zip(pairs, again, strict=True):
        assert one.image == other.image
        np.testing.assert_array_equal(one.guess, other.guess)
    assert {pair.image for pair in pairs[:25]} != {pair.image for pair in pairs[25:]}
    for pair in pairs:
        assert 10 - 1e-6 <= pair.guess_error[0] <= 40 + 1e-6
        distance = np.linalg.norm(camera_centre(pair.guess))
        assert abs(distance - np.linalg.norm(camera_centre(pair.truth))) <= 0.2 + 1e-9


def test_scores_by_hand() -> None:
    scores = score([answer(1, 0.01), answer(2, 0.1), answer(30, 0.02, seconds=5), answer(None)])
    assert scores["share_re_below_5deg"] == 0.5
    assert scores["share_te_below_0.05"] == 0.5
    assert scores["share_both_below"] == 0.25
    assert scores["share_ok"] == 0.75
    assert scores["share_ok_right"] == pytest.approx(1 / 3)
    assert scores["mean_re_deg"] == pytest.approx(11)
    assert scores["median_re_deg"] == pytest.approx(2)
    assert scores["seconds_per_image"] == 2
    assert scores["covariance"] is None


def test_stages_times_are_means_over_the_answered_pairs() -> None:
    pose = np.eye(4)
    times: list[dict[str, float]] = [{"pnp": 2.0, "retrieval": 4.0}, {"pnp": 4.0}]
    answers = [Answer(PAIR, pose, None, 1.0, stage_ms=ms) for ms in times]
    assert score([*answers, answer(None)])["stage_ms"] == {"pnp": 3.0, "retrieval": 2.0}
    assert score([answer(1)])["stage_ms"] is None


def test_without_any_pose_the_errors_are_unknown() -> None:
    scores = score([answer(None), answer(None)])
    assert scores["share_ok"] == scores["share_re_below_5deg"] == 0
    assert scores["mean_re_deg"] is scores["share_ok_right"] is None


def test_a_true_covariance_covers_what_it_says() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * 1e-3
    covariance = root @ root.T
    pair = Pair(0, 0, TRUTHS[0], TRUTHS[0])
    answers = [Answer(pair, exp_se3(-(root @ rng.normal(size=6))) @ TRUTHS[0], covariance, 0.0) for _ in range(4000)]
    covered = score(answers)["covariance"]
    assert [covered[p] for p in ("50", "90", "99")] == pytest.approx([0.5, 0.9, 0.99], abs=0.03)


def over(pairs: list[Pair], errors: list[tuple[float | None, float]]) -> list[Answer]:
    """Answers to pairs with these errors."""
    return [answer(turn, shift, pair=pair) for pair, (turn, shift) in zip(pairs, errors, strict=True)]


def test_differences_are_taken_pair_by_pair() -> None:
    rng = np.random.default_rng(1)
    base = rng.uniform(0, 10, 60)
    pairs = [Pair(0, i, np.eye(4), np.eye(4)) for i in range(61)]
    first = over(pairs, [*((b + 0.5, 0.02) for b in base), (None, 0.0)])
    second = over(pairs, [*((b, 0.02) for b in base), (1.0, 0.0)])
    gap = difference(first, second[::-1])
    assert (gap["pairs"], gap["pairs_answered"]) == (61, 60)
    assert gap["re_deg"] == pytest.approx({"mean": 0.5, "low": 0.5, "high": 0.5})
    assert gap["te"]["mean"] == pytest.approx(0)
    assert difference(first[:5], second)["pairs"] == 5
    assert difference(first[60:], second[60:])["re_deg"] is None


def test_a_missing_pose_counts_as_far_off_where_errors_are_capped() -> None:
    pairs = [Pair(0, i, np.eye(4), np.eye(4)) for i in range(3)]
    first = over(pairs, [(None, 0.0), (170, 9.0), (3, 0.1)])
    gap = difference(first, over(pairs, [(2, 0.05), (30, 1.0), (1, 0.1)]))
    assert gap["pairs_answered"] == 2
    assert gap["capped_re_deg"]["mean"] == pytest.approx((18 + 0 + 2) / 3)
    assert gap["capped_te"]["mean"] == pytest.approx((0.15 + 0 + 0) / 3)


def test_success_curves_count_missing_poses_as_failures() -> None:
    answers = [answer(1), answer(3), answer(None), answer(20)]
    np.testing.assert_allclose(curve(answers, 0, np.array([0.5, 2, 5, 180])), [0, 0.25, 0.5, 0.75])


def test_methods_are_compared_on_the_demo_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field = demo_file("field.safetensors")
    figures, plot = tmp_path / "scores.json", tmp_path / "curves.png"
    arguments = ["evaluate", field, field.parent, "--method", "one-step", "--method", "full", "--seeds", 0]
    arguments += ["--images", 2, "--poses", 1, "--size", 320, "--json", figures, "--plot", plot]
    assert main([str(argument) for argument in arguments]) == 0
    written = json.loads(figures.read_text())
    assert written["pairs"] == 2
    assert list(written["methods"]) == ["one-step", "full"]
    assert written["methods"]["full"]["share_both_below"] == 1
    assert written["methods"]["full"]["mean_re_deg"] < 0.5
    assert written["differences"]["full"]["pairs"] >= 1
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert "right of ok" in capsys.readouterr().out


def test_what_any_method_solves_is_solvable() -> None:
    pairs = [Pair(0, i, np.eye(4), np.eye(4)) for i in range(4)]

    def given(*errors: float | None) -> list[Answer]:
        return [replace(answer(error), pair=pair) for error, pair in zip(errors, pairs, strict=False)]

    first, second = given(1, None, 20, 20), given(1, 2, 20)
    assert share_of_solvable(first, [first, second]) == 0.5
    assert share_of_solvable(second, [first, second]) == 1
    assert share_of_solvable(given(50), [given(60)]) is None


def test_translations_without_a_scale_are_left_out() -> None:
    unscaled = [replace(answer(1, 3.0), scale_known=False), replace(answer(9, 0.0), scale_known=False)]
    scores = score(unscaled)
    assert scores["share_re_below_5deg"] == 0.5
    assert scores["mean_re_deg"] == pytest.approx(5)
    assert share_of_solvable(unscaled, [[answer(1)]]) is None
    assert scores["mean_te"] is scores["share_te_below_0.05"] is scores["share_ok_right"] is None
    gap = difference(unscaled[1:], [answer(1)])
    assert gap["re_deg"]["mean"] == pytest.approx(8)
    assert gap["te"] is None


def test_reach_turns_or_shifts() -> None:
    protocol = replace(PROTOCOLS["reach"], max_translation=2.0)
    for i, pair in enumerate(draw(protocol, TRUTHS, (0,))):
        turn, shift = pair.guess_error
        assert (turn < 1e-5) == bool(i % 2)
        assert turn <= 180
        if i % 2:
            assert shift <= 2.0


def test_cameras_may_be_turned_about_themselves() -> None:
    protocol = replace(PROTOCOLS["llff"], turn_about="camera")
    for pair in draw(protocol, TRUTHS, (0,)):
        assert pair.guess_error[1] <= 0.1 + 1e-9


@pytest.mark.parametrize("protocol", ["occluded", "reach"])
def test_the_other_protocols_run_too(protocol: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field = demo_file("field.safetensors")
    figures, plot = tmp_path / "scores.json", tmp_path / "plot.png"
    arguments = ["evaluate", field, field.parent, "--protocol", protocol, "--method", "one-step", "--seeds", 0]
    arguments += ["--images", 2, "--poses", 2, "--size", 200, "--json", figures, "--plot", plot, "--shift", 0.3]
    assert main([str(argument) for argument in arguments]) == 0
    written = json.loads(figures.read_text())
    assert written["pairs"] == 4
    assert written["protocol"]["max_translation"] == 0.3
    assert (written["covered"] is not None) == (protocol == "occluded")
    assert 0 <= written["methods"]["one-step"]["add"]["auc_add"] <= 1
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert protocol in capsys.readouterr().out


def test_published_methods_run_on_the_same_pairs(tmp_path: Path) -> None:
    field = demo_file("field.safetensors")
    figures = tmp_path / "scores.json"
    arguments = ["evaluate", field, field.parent, "--method", "essential", "--method", "inerf", "--slow-pairs", 1]
    arguments += ["--seeds", 0, "--images", 2, "--poses", 1, "--size", 160, "--json", figures]
    assert main([str(argument) for argument in arguments]) == 0
    methods = json.loads(figures.read_text())["methods"]
    assert [methods[name]["pairs"] for name in ("essential", "inerf")] == [2, 1]
    assert methods["essential"]["mean_te"] is None
    assert methods["inerf"]["share_ok"] == 1


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--images", "0"], "--images must be at least 1"),
        (["--seeds", "-1"], "--seeds one or more from 0 on"),
        (["--shift", "-0.1"], "expected a length of 0 or more"),
        (["--angle-deg", "40", "10"], "expected 0 <= least <= most <= 180"),
        (["--occluders", "somewhere"], "use --protocol occluded"),
        (["--plot", "curves.txt"], "ends with .png"),
    ],
)
def test_flags_that_mean_nothing_are_refused_at_once(
    flags: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    field = demo_file("field.safetensors")
    assert main(["evaluate", str(field), str(field.parent), *flags]) == 2
    assert message in capsys.readouterr().err


def test_guesses_of_one_image_are_resampled_together() -> None:
    """Ten times the guesses of the same two images say no more about other images."""
    few = [replace(answer(error), pair=Pair(0, i, np.eye(4), np.eye(4))) for i, error in enumerate((1.0, 3.0))]
    many = [replace(a, pair=replace(a.pair)) for a in few for _ in range(10)]
    for answers in (few, many):
        gap = difference(answers, [replace(a, cam_from_object=np.eye(4)) for a in answers])["re_deg"]
        assert gap == pytest.approx({"mean": 2.0, "low": 1.0, "high": 3.0}, abs=1e-6)


def test_an_unknown_method_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field = demo_file("field.safetensors")
    assert main(["evaluate", str(field), str(field.parent), "--method", "guessing"]) == 2
    assert "method 'guessing': expected all, or one of one-step," in capsys.readouterr().err


@pytest.mark.parametrize(
    ("seeds", "told"),
    [((0, 1, 2, 3), "0 to 3"), ((5,), "5"), ((1, 2), "1, 2"), ((0, 2, 3), "0, 2, 3"), ((2, 1, 0), "2, 1, 0")],
)
def test_seeds_are_told_in_short(seeds: tuple[int, ...], told: str) -> None:
    assert in_short(seeds) == told


def test_methods_take_turns_image_by_image_and_what_there_is_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[dict[str, Any]] = []
    turns, asked = Examination.answers, list[tuple[str, int]]()

    class Nowhere:
        def find(self, *question: object) -> PoseFound:
            return PoseFound(Reason.NO_CONSENSUS)

    def noted(*given: Any) -> Iterator[tuple[str, Answer]]:
        for name, found in turns(*given):
            asked.append((name, found.pair.image))
            yield name, found

    monkeypatch.setattr(Examination, "answers", noted)
    methods = {"quick": Method(lambda *given: Nowhere()), "slow": Method(lambda *given: Nowhere(), slow=True)}
    monkeypatch.setattr("fieldpose.deploy.evaluation.methods.METHODS", methods)
    monkeypatch.setattr("fieldpose.deploy.evaluation.running.METHODS", methods)
    monkeypatch.setattr("fieldpose.deploy.commands.evaluate._WRITTEN_EVERY_S", -1.0)
    monkeypatch.setattr("fieldpose.deploy.commands.evaluate.write_json", lambda path, figures: written.append(figures))
    field = demo_file("field.safetensors")
    arguments = ["evaluate", field, field.parent, "--method", "all", "--seeds", 0, "--images", 2, "--poses", 2]
    arguments += ["--size", 100, "--slow-pairs", 2, "--json", tmp_path / "scores.json"]
    assert main([str(argument) for argument in arguments]) == 0
    first, second = asked[0][1], asked[-1][1]
    assert first != second
    by_image = [("quick", first), ("quick", first), ("slow", first), ("quick", second), ("quick", second)]
    assert asked == [*by_image, ("slow", second)]
    assert list(written[0]["methods"]) == ["quick"]
    assert written[0]["methods"]["quick"]["pairs"] == 1
    assert [part["methods"].get("slow", {}).get("pairs", 0) for part in written] == [0, 0, 1, 1, 1, 2, 2]
