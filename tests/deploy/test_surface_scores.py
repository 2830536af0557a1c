"""ADD, ADD-S and their curves, against cases worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.deploy.evaluation.surface import Surface, add, add_s, area_under_curve, read_surface, surface_of
from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import camera_centre, look_at, rotation_about
from fieldpose.stages.nerf.metadata import TrainingCamera

SQUARE = Surface(np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]))


def shifted(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def test_a_shift_moves_every_point_by_itself() -> None:
    assert add(shifted(0.25), np.eye(4), SQUARE) == pytest.approx(0.25)
    assert add_s(shifted(0.25), np.eye(4), SQUARE) == pytest.approx(0.25)
    assert add(np.eye(4), np.eye(4), SQUARE) == add_s(np.eye(4), np.eye(4), SQUARE) == 0


def test_a_symmetry_counts_for_add_and_not_for_add_s() -> None:
    turned = rotation_about((0, 0, 1), np.pi / 2)
    assert add(turned, np.eye(4), SQUARE) == pytest.approx(np.sqrt(2))
    assert add_s(turned, np.eye(4), SQUARE) == pytest.approx(0, abs=1e-12)


def test_a_turn_by_hand() -> None:
    turned = rotation_about((0, 0, 1), np.deg2rad(60))
    assert add(turned, np.eye(4), SQUARE) == pytest.approx(1.0)  # chords of 60 degrees on the unit circle
    nearest = 2 * np.sin(np.deg2rad(15))  # the next corner is 30 degrees away
    assert add_s(turned, np.eye(4), SQUARE) == pytest.approx(nearest)


def test_the_diameter_is_the_largest_distance() -> None:
    assert SQUARE.diameter == pytest.approx(2.0)
    cube = Surface(np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T.astype(float))
    assert cube.diameter == pytest.approx(np.sqrt(3))


def test_the_area_under_the_curve_by_hand() -> None:
    assert area_under_curve([0.0, 0.0], 0.1) == 1
    assert area_under_curve([0.05], 0.1) == pytest.approx(0.5)
    assert area_under_curve([0.0, 0.025, 0.2, np.inf], 0.1) == pytest.approx((1 + 0.75) / 4)
    assert area_under_curve([], 0.1) == 0


def test_the_surface_of_a_field_is_where_its_views_see_it() -> None:
    scene, seen_by = AnalyticScene(), camera(64)
    poses = [viewpoint(), look_at(-camera_centre(viewpoint()), (0, 0, 0), (0, 0, 1))]
    views = [
        TrainingCamera(f"{i}", 64, 64, seen_by.fx, seen_by.fy, seen_by.cx, seen_by.cy, (0.0,) * 5, tuple(pose.ravel()))
        for i, pose in enumerate(poses)
    ]
    surface = surface_of(scene, views, np.random.default_rng(0))
    assert surface is not None
    assert len(surface.points) > 200
    for pose in poses[:1]:
        expected = scene.render_view(seen_by, pose)
        in_cam = surface.points @ pose[:3, :3].T + pose[:3, 3]
        nearest = in_cam[:, 2].min()
        assert nearest == pytest.approx(expected.depth[expected.opacity > 0.5].min(), abs=0.05)
    assert surface_of(scene, [], np.random.default_rng(0)) is None


def test_a_file_of_points_is_checked(tmp_path: Path) -> None:
    good, flat, broken = tmp_path / "good.npy", tmp_path / "flat.npy", tmp_path / "broken.npy"
    np.save(good, SQUARE.points)
    np.save(flat, np.zeros(5))
    broken.write_bytes(b"points")
    np.testing.assert_array_equal(read_surface(good).points, SQUARE.points)
    with pytest.raises(DatasetError, match=r"shape \(n, 3\), got float64 \(5,\)"):
        read_surface(flat)
    with pytest.raises(DatasetError, match="no readable"):
        read_surface(broken)
    with pytest.raises(DatasetError, match="no readable"):
        read_surface(tmp_path / "missing.npy")
