"""A field in another frame: what it shows, and by which derivatives, is what it showed where that was before."""

from __future__ import annotations

import itertools
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.surfaces import BALL_RADIUS, ball_field

from fieldpose.errors import ConfigError, DatasetError
from fieldpose.stages.geometry import Camera, Similarity, camera_centre, look_at, rotation_about
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import Field, load_field, load_metadata, new_net
from fieldpose.stages.nerf.framing import in_dataset_frame, reframed, shown_at
from fieldpose.stages.nerf.metadata import CameraFit, FieldMetadata, Frame, PoseAccuracy, Space
from fieldpose.stages.nerf.normalise import normalised_points, object_points
from fieldpose.stages.nerf.renderer import NumbaRenderer
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.nerf.surface.extract import region_of
from fieldpose.stages.nerf.torch_renderer import TorchRenderer

SPACES = {
    "box": Space(False, (0.1, -0.2, 0.3), 1.5, half=(1.0, 0.8, 0.9), step=0.03),
    "ball": Space(True, (0.1, -0.2, 0.3), 1.5, near=0.05, far=20.0, step=0.06),
    "part": Space(True, (0.1, -0.2, 0.3), 3.0, near=0.05, far=20.0, step=0.03, box=(-0.5, -0.5, -0.4, 0.6, 0.2, 0.6)),
}
CONFIG = FieldConfig(
    levels=3, log2_table=9, finest_resolution=64, hidden=16, features=6, colour_hidden=8, occupancy_resolution=16
)
MOVED = Similarity(0.4, rotation_about(np.array([1.0, 2.0, -0.5]), 1.1)[:3, :3], np.array([3.0, -1.0, 2.0]))
AGAIN = Similarity(5.0, rotation_about(np.array([0.0, -2.0, 1.0]), -2.0)[:3, :3], np.array([-1.0, 0.5, 0.0]))


def field_in(space: Space) -> Field:
    rng = np.random.default_rng(4)
    net = new_net(CONFIG, rng)
    net.table[:] = rng.normal(0, 0.7, net.table.shape)
    return Field(FieldMetadata(space, CONFIG, (1.0, 0.5, 0.0), [], "test", ""), net, rng.random((16, 16, 16)) < 0.3)


def moved_field(field: Field, by: Similarity) -> Field:
    return Field(reframed(field.metadata, by), field.net, field.occupied)


def renderer_of(kind: str, field: Field) -> RayRenderer:
    return NumbaRenderer(field, stop_below=0.0) if kind == "numba" else TorchRenderer(field)


@pytest.mark.parametrize("space", sorted(SPACES))
@pytest.mark.parametrize("kind", ["numba", "torch"])
def test_a_view_from_the_moved_pose_is_the_same(space: str, kind: str) -> None:
    field = field_in(SPACES[space])
    camera, pose = Camera(37, 29, 40.0, 42.0, 17.0, 15.0), look_at((1, -4, 1), (0, 0, 0), (0, 0, 1))
    before = renderer_of(kind, field).render_view(camera, pose)
    after = renderer_of(kind, moved_field(field, MOVED)).render_view(camera, MOVED.of_poses(pose[None])[0])
    solid = before.opacity > 0.5
    assert solid.any()
    # Where a ray just meets or misses a cell, rounding decides.
    same = np.abs(after.rgb.astype(int) - before.rgb).max(axis=-1) <= 3
    assert same.mean() > 0.99
    close = np.abs(after.depth / MOVED.scale - before.depth) < 2e-3 * before.depth.max()
    assert close[solid].mean() > 0.97
    np.testing.assert_allclose(np.median(after.depth[solid]) / MOVED.scale, np.median(before.depth[solid]), rtol=1e-4)


@pytest.mark.parametrize("space", sorted(SPACES))
@pytest.mark.parametrize("kind", ["numba", "torch"])
def test_derivatives_go_along(space: str, kind: str) -> None:
    field, rng = field_in(SPACES[space]), np.random.default_rng(0)
    origins = rng.normal(0, 2.5, (64, 3))
    directions = rng.normal(0, 0.7, (64, 3)) - origins
    weights = np.eye(3, dtype=np.float32)
    turn = MOVED.scale * MOVED.rotation
    there = MOVED.of_points(origins).astype(np.float32), (directions @ turn.T).astype(np.float32)
    before, by_old = renderer_of(kind, field).render_rays_jacobian(
        origins.astype(np.float32), directions.astype(np.float32), weights
    )
    after, by_new = renderer_of(kind, moved_field(field, MOVED)).render_rays_jacobian(*there, weights)
    chained = np.concatenate([by_new[..., :3] @ turn, by_new[..., 3:] @ turn], axis=-1)
    np.testing.assert_allclose(np.median(np.abs(after.rgb - before.rgb)), 0, atol=1e-4)
    error = np.abs(chained - by_old).max(axis=(1, 2))
    assert np.abs(by_old).max() > 0.1
    assert (error < 0.02 * (1 + np.abs(by_old).max(axis=(1, 2)))).mean() > 0.9


@pytest.mark.parametrize("space", sorted(SPACES))
def test_coordinates_lead_there_and_back(space: str) -> None:
    moved = reframed(field_in(SPACES[space]).metadata, MOVED).space
    points = np.random.default_rng(2).normal(size=(9, 3))
    np.testing.assert_allclose(object_points(moved, normalised_points(moved, points)), points, atol=1e-12)
    np.testing.assert_allclose(
        normalised_points(moved, MOVED.of_points(points)), normalised_points(SPACES[space], points), atol=1e-12
    )


@pytest.mark.parametrize("name", ["box", "part"])
def test_a_turned_box_lies_in_its_region(name: str) -> None:
    space = SPACES[name]
    moved = reframed(field_in(space).metadata, MOVED).space
    assert space.corners is not None
    corners = np.array(list(itertools.product(*space.corners.T)))
    there = object_points(moved, corners)
    box = region_of(moved).box
    np.testing.assert_allclose(box, np.stack([there.min(axis=0), there.max(axis=0)]), atol=1e-12)


def test_changes_add_up_and_are_taken_back(tmp_path: Path) -> None:
    metadata = msgspec.structs.replace(
        ball_field(metres_per_unit=0.2).metadata,
        accuracy=PoseAccuracy(5, 5, 0.1, 0.02, 1.0),
        camera_fit=CameraFit("fit", 400, (90.0, 90.0), translation=(0.01, 0.03)),
    )
    twice = reframed(reframed(metadata, MOVED), AGAIN)
    whole = AGAIN.after(MOVED)
    frame = twice.frame.object_from_dataset
    np.testing.assert_allclose(frame.rotation, whole.rotation, atol=1e-12)
    np.testing.assert_allclose(frame.translation, whole.translation, atol=1e-12)
    assert frame.scale == pytest.approx(2.0)
    assert (twice.metres_per_unit, twice.frame.unit) == (pytest.approx(0.1), "span")
    assert msgspec.to_builtins(twice.accuracy)["translation"] == pytest.approx(0.04)
    assert msgspec.to_builtins(twice.camera_fit)["translation"] == pytest.approx((0.02, 0.06))
    path = tmp_path / "moved.safetensors"
    Field(twice, ball_field().net, ball_field().occupied).save(path)
    assert load_metadata(path) == load_field(path).metadata == twice
    back = in_dataset_frame(twice)
    assert (back.unit, back.metres_per_unit, back.frame) == (metadata.unit, 0.2, metadata.frame)
    np.testing.assert_allclose([c.pose for c in back.cameras], [c.pose for c in metadata.cameras], atol=1e-12)
    np.testing.assert_allclose(back.space.turn, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(back.space.centre, (0, 0, 0), atol=1e-12)
    assert Frame().object_from_dataset.scale == 1


def test_a_pixel_shows_a_point_of_the_surface() -> None:
    field = ball_field()
    moved = moved_field(field, MOVED)
    renderer, view = NumbaRenderer(moved), moved.metadata.cameras[3]
    point = shown_at(renderer, moved.metadata, "3", 31.5, 31.5)
    centre, eye = MOVED.translation, camera_centre(view.pose)
    assert np.linalg.norm(point - centre) == pytest.approx(BALL_RADIUS * MOVED.scale, rel=0.1)
    np.testing.assert_allclose(np.cross(point - eye, centre - eye), 0, atol=1e-4)
    with pytest.raises(ConfigError, match=r"3 shows nothing solid at pixel 0,0"):
        shown_at(renderer, moved.metadata, "3", 0, 0)
    with pytest.raises(ConfigError, match=r"pixel 64,3 is not in 3, which was learnt at 64x64"):
        shown_at(renderer, moved.metadata, "3", 64, 3)
    with pytest.raises(DatasetError, match="nobody"):
        shown_at(renderer, moved.metadata, "nobody", 1, 1)
