"""What is left open is decided once, by source, field and machine, and each decision is told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.tracking_world import ring_of_views

from fieldpose.deploy.plan import resolve
from fieldpose.deploy.settings import Settings, changed, read_settings, to_json
from fieldpose.errors import ConfigError, SourceError
from fieldpose.stages.nerf.training_views import TrainingViews

VIEWS = ring_of_views()
KNOWN = TrainingViews(VIEWS.names, VIEWS.cam_from_object, np.zeros((len(VIEWS.names), 4, 64), np.int8))


def settings(**changes: Any) -> Settings:
    return changed(Settings(), changes, "test")


def from_source(source: str, **changes: Any) -> Settings:
    return settings(camera={"source": source}, **changes)


@pytest.mark.parametrize("source", ["video:a.mp4", "camera:0", "mcap:a.mcap", "bus", ""])
def test_videos_get_small_views_used_again_and_no_refinement(source: str) -> None:
    plan = resolve(from_source(source), KNOWN)
    chosen = plan.settings
    assert (chosen.tracking.sequence, chosen.rendering.size, chosen.refinement.when) == ("video", 256, "never")
    assert plan.follows
    assert (chosen.rendering.reuse_angle_deg, plan.in_flight) == (0.0, 1)
    assert not plan.independent
    assert chosen.camera.pace == ("live" if source else "auto")


def test_videos_that_are_not_followed_get_views_used_again() -> None:
    for changes in ({"following": {"when": "never"}}, {"camera": {"source": "mcap:a.mcap", "pace": "lockstep"}}):
        plan = resolve(changed(from_source("mcap:a.mcap"), changes, "test"), KNOWN)
        assert not plan.follows
        assert plan.settings.rendering.reuse_angle_deg == 5.0
        assert plan.notes["following"].startswith("off")
    forced = {"following": {"when": "always"}, "camera": {"source": "mcap:a.mcap", "pace": "lockstep"}}
    assert resolve(changed(from_source("mcap:a.mcap"), forced, "test"), KNOWN).follows


def test_a_cuda_device_is_not_used_where_single_views_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldpose.deploy.plan.resolved", lambda wanted: "cuda" if wanted == "auto" else wanted)
    assert resolve(from_source("mcap:a.mcap"), KNOWN).settings.backend == "numba"
    assert resolve(from_source("mcap:a.mcap", backend="cuda"), KNOWN).settings.backend == "cuda"
    assert resolve(from_source("folder:a"), KNOWN).settings.backend == "cuda"


def test_frames_that_stand_by_themselves_cannot_be_followed() -> None:
    for source, tracking in (("folder:a", {}), ("mcap:a.mcap", {"guess": "perturb:10-40deg,0.2"})):
        with pytest.raises(ConfigError, match="not frames of a video"):
            resolve(from_source(source, tracking=tracking, following={"when": "always"}), KNOWN)


@pytest.mark.parametrize("source", ["folder:a", "dataset:a:test"])
def test_photos_stand_each_by_itself_and_are_refined_one_after_the_other(source: str) -> None:
    plan = resolve(from_source(source), KNOWN)
    chosen = plan.settings
    assert (chosen.tracking.sequence, chosen.rendering.size, chosen.refinement.when) == ("photos", 400, "always")
    assert chosen.rendering.reuse_angle_deg == 0.0
    assert plan.independent
    assert (chosen.camera.pace, plan.in_flight) == ("lockstep", 1)


def test_what_is_said_is_not_decided_anew() -> None:
    said = from_source(
        "camera:0", tracking={"sequence": "photos"}, rendering={"size": 320, "reuse_angle_deg": 2.0},
        refinement={"when": "never"}, matching={"device": "meta"}, backend="torch",
    )  # fmt: skip
    chosen = resolve(said, KNOWN).settings
    assert (chosen.tracking.sequence, chosen.rendering.size, chosen.rendering.reuse_angle_deg) == ("photos", 320, 2.0)
    assert (chosen.refinement.when, chosen.matching.device, chosen.backend) == ("never", "meta", "torch")


@pytest.mark.parametrize("source", ["", "dataset:a:test", "mcap:a.mcap"])
def test_a_plan_read_back_is_the_same_plan(source: str, tmp_path: Any) -> None:
    """As the processes get it, and a recording keeps it."""
    first = resolve(from_source(source, tracking={"guess": "perturb:10-40deg,0.2"}), KNOWN)
    path = tmp_path / "settings.json"
    path.write_bytes(to_json(first.settings))
    again = resolve(read_settings(path), KNOWN)
    assert again.settings == first.settings
    assert again.begins == first.begins
    assert (again.looks, again.independent, again.follows) == (first.looks, first.independent, first.follows)
    said = to_json(first.settings).decode().replace('"holdout": "auto"', "")
    assert "auto" not in said.replace('"pace": "auto"' if not source else "-", "")


def test_guesses_for_each_frame_make_frames_independent() -> None:
    plan = resolve(from_source("mcap:a.mcap", tracking={"guess": "perturb:10-40deg,0.2"}), KNOWN)
    assert plan.begins.disturbance is not None
    assert plan.independent
    assert plan.settings.rendering.reuse_angle_deg == 0.0
    assert plan.settings.rendering.size == 256
    start = resolve(from_source("mcap:a.mcap", tracking={"guess": "train:r_3"}), KNOWN)
    np.testing.assert_array_equal(start.begins.start, VIEWS.cam_from_object[3])


def test_retrieval_is_asked_where_the_field_remembers_its_views() -> None:
    assert resolve(settings(), KNOWN).looks
    forgetful = resolve(settings(), VIEWS)
    assert not forgetful.looks
    assert "train it again" in forgetful.notes["retrieval"]
    assert not resolve(settings(retrieval={"candidates": 0}), KNOWN).looks


def test_every_decision_is_told() -> None:
    notes = resolve(from_source("folder:a"), KNOWN).notes
    told = {"sequence", "retrieval", "guess", "backend", "pace", "following", "refinement"}
    told |= {"view size", "views used again"}
    assert set(notes) == told
    assert all("auto" in notes[name] for name in told - {"retrieval", "guess", "following"})


def test_what_cannot_be_is_refused_before_anything_starts() -> None:
    with pytest.raises(SourceError, match="expected one of"):
        resolve(from_source("tape:3"), KNOWN)
    with pytest.raises(ConfigError, match="nowhere"):
        resolve(settings(tracking={"guess": "nowhere.json"}), KNOWN)


def test_guesses_made_from_the_truth_need_a_source_that_knows_it() -> None:
    for source in ("folder:a", "video:a.mp4", "camera:0"):
        with pytest.raises(ConfigError, match="does not know"):
            resolve(from_source(source, tracking={"guess": "perturb:10-40deg,0.2"}), KNOWN)
    assert resolve(from_source("dataset:a:test", tracking={"guess": "perturb:10-40deg,0.2"}), KNOWN).begins.by_frame


def test_a_file_of_guesses_is_found_from_any_folder(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "guess.json").write_text('{"cam_from_object": [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}')
    monkeypatch.chdir(tmp_path)
    plan = resolve(from_source("folder:a", tracking={"guess": "guess.json"}), KNOWN)
    assert plan.settings.tracking.guess == str(tmp_path / "guess.json")


def test_infinity_survives_the_way_to_the_processes(tmp_path: Any) -> None:
    plan = resolve(settings(tracking={"motion": {"damping_ms": float("inf")}}), KNOWN)
    path = tmp_path / "settings.json"
    path.write_bytes(to_json(plan.settings))
    assert read_settings(str(path)).tracking.motion.damping_ms == float("inf")


@pytest.mark.parametrize(
    ("stage", "setting"), [("rendering", {"size": -5}), ("lifting", {"views": -1}), ("refinement", {"samples": 0})]
)
def test_numbers_that_mean_nothing_are_refused_by_name(stage: str, setting: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=f"{stage}: {next(iter(setting))} is "):
        settings(**{stage: setting})
