"""Landmarks of a view, on a scene whose geometry is known exactly and on pictures that have none."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.stages.alignment import landmarks as of_views
from fieldpose.stages.geometry import rays
from fieldpose.stages.nerf.rendering_api import RenderedView
from fieldpose.stages.pnp.aligner import Pictures

VIEW = camera(200)
POSE = viewpoint(25.0, 38.0)


@pytest.fixture(scope="module")
def scene() -> AnalyticScene:
    return AnalyticScene()


@pytest.fixture(scope="module")
def view(scene: AnalyticScene) -> RenderedView:
    return scene.render_view(VIEW, POSE)


@pytest.fixture(scope="module")
def pictures(view: RenderedView) -> Pictures:
    return Pictures(view.rgb, view.depth, VIEW, POSE, view.rgb)


def landmarks(pictures: Pictures, most: int) -> np.ndarray:
    return of_views.landmarks(pictures.grey, pictures.depth, pictures.camera, pictures.cam_from_object, most)


def pixels_of(points: np.ndarray) -> np.ndarray:
    return VIEW.project(points @ POSE[:3, :3].T + POSE[:3, 3])


def test_they_are_where_pixels_of_the_view_show_the_surface(pictures: Pictures, scene: AnalyticScene) -> None:
    found = landmarks(pictures, 50)
    pixels = pixels_of(found)
    assert len(found) == 50
    assert np.allclose(pixels, np.rint(pixels), atol=1e-3)
    seen = scene.render_rays(*rays(VIEW, POSE, np.rint(pixels).astype(np.float32)))
    distance = np.linalg.norm(found + POSE[:3, :3].T @ POSE[:3, 3], axis=1)
    along = np.linalg.norm(rays(VIEW, POSE, np.rint(pixels).astype(np.float32))[1], axis=1)
    assert np.allclose(distance, seen.depth * along, atol=2e-3)


def test_none_is_where_the_depth_steps(pictures: Pictures) -> None:
    column, row = np.rint(pixels_of(landmarks(pictures, 500))).astype(int).T
    around = [pictures.depth[row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    nearest, farthest = np.min(around, axis=0), np.max(around, axis=0)
    assert len(column) > 100
    assert (nearest > 0).all()
    assert (farthest - nearest < 0.1 * farthest).all()


def test_the_ones_with_the_most_texture_come_first(pictures: Pictures) -> None:
    few, many = landmarks(pictures, 20), landmarks(pictures, 200)
    assert len(few) == 20 < len(many) <= 200
    assert np.array_equal(few, many[:20])
    column, row = np.rint(pixels_of(many)).astype(int).T
    texture = cv2.cornerMinEigenVal(pictures.grey, 5)[row, column]
    assert texture[:20].min() > np.median(texture) > 1.5 * texture[-20:].max()


def test_they_keep_apart(pictures: Pictures) -> None:
    pixels = pixels_of(landmarks(pictures, 500))
    apart = np.linalg.norm(pixels[:, None] - pixels, axis=2) + 1e3 * np.eye(len(pixels))
    assert apart.min() >= 3.99


def test_a_plain_picture_has_none(pictures: Pictures) -> None:
    assert landmarks(replace(pictures, view=np.full_like(pictures.view, 90)), 100).shape == (0, 3)


@pytest.mark.parametrize("size", [(4, 200), (200, 4), (1, 1)])
def test_nor_has_one_smaller_than_the_window(size: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    assert landmarks(Pictures(noise, np.ones(size, np.float32), VIEW, POSE, noise), 100).shape == (0, 3)


def test_nor_has_one_that_shows_no_surface(pictures: Pictures) -> None:
    assert landmarks(replace(pictures, depth=np.zeros_like(pictures.depth)), 100).shape == (0, 3)


def test_none_are_taken_if_none_are_wanted(pictures: Pictures) -> None:
    assert landmarks(pictures, 0).shape == (0, 3)
