"""What the images say of cells: silhouettes and errors held together, and that what was judged empty comes back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.wires import wires

from fieldpose.stages.geometry import Camera, camera_centre, look_at
from fieldpose.stages.nerf import training
from fieldpose.stages.nerf.blocks import SIDE, Blocks, View
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.exploration import due, missing
from fieldpose.stages.nerf.hull import BEHIND, SLACK_PX, Marked, hull, seen_in
from fieldpose.stages.nerf.metadata import FieldMetadata, Space
from fieldpose.stages.nerf.occupancy import OccupancyEstimate, cell_positions, cell_radii, from_cube
from fieldpose.stages.nerf.renderer import NumbaRenderer
from fieldpose.stages.nerf.training import Trainer

SPACE = Space(False, (0.1, -0.2, 0.3), 1.2, step=2 / 96)
CAMERA = Camera(60, 44, 55.0, 55.0, 29.5, 21.5)
BALL = Space(True, (0.0, 0.0, 0.0), 4.0, near=0.05, far=64.0, step=1 / 64)


def around(count: int, distance: float, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    eyes = rng.normal(size=(count, 3))
    eyes *= distance / np.linalg.norm(eyes, axis=1, keepdims=True)
    return [look_at(eye + SPACE.centre, np.array(SPACE.centre), rng.normal(size=3)) for eye in eyes]


def shadow(centre: np.ndarray, radius: float, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Pixels (h, w) bool whose ray meets a ball."""
    d = camera.directions(camera.grid()).astype(np.float64)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    towards = pose[:3, :3] @ centre + pose[:3, 3]
    along = d @ towards
    return ((towards @ towards - along**2 < radius**2) & (along > 0)).reshape(camera.height, camera.width)


def centres(space: Space, n: int) -> np.ndarray:
    return from_cube(space, cell_positions(np.arange(n**3), n, np.full((1, 3), 0.5)))


@given(st.integers(0, 2**32 - 1), st.floats(0.15, 0.5))
@settings(max_examples=15, deadline=None)
def test_the_hull_holds_the_object_and_little_else(seed: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    centre = SPACE.centre + rng.uniform(-0.5, 0.5, 3)
    marked = [Marked(shadow(centre, radius, CAMERA, pose), CAMERA, pose) for pose in around(24, 4.0, seed)]
    found = hull(marked, SPACE, np.ones((64, 64, 64), bool), 0.0).ravel()
    away = np.linalg.norm(centres(SPACE, 64) - centre, axis=1)
    assert found[away < radius].all()
    cell, pixel = np.sqrt(3) * SPACE.scale / 64, 4.7 / 55
    assert not found[away > 1.6 * (radius + cell + (SLACK_PX + 1) * pixel)].any()


@pytest.mark.parametrize("n", [8, 24, 40, 72, 96])
def test_the_grid_may_have_any_side_that_fields_may_have(n: int) -> None:
    marked = [Marked(shadow(np.array(SPACE.centre), 0.5, CAMERA, pose), CAMERA, pose) for pose in around(6, 4.0, 1)]
    found = hull(marked, SPACE, np.ones((n, n, n), bool), 0.0).ravel()
    assert found[np.linalg.norm(centres(SPACE, n) - SPACE.centre, axis=1) < 0.5].all()
    assert not found.all()


@pytest.mark.parametrize("space", [SPACE, BALL])
@pytest.mark.parametrize("hidden", [False, True])
def test_hull_as_its_plain_twin(space: Space, hidden: bool) -> None:
    """Cell by cell, without going from coarse to fine, which loses a few at borders of images and behind surfaces."""
    focal = 14.0 if space.contracted or hidden else 30.0
    wide, marked = Camera(60, 44, focal, focal, 29.5, 21.5), []
    for i, pose in enumerate(around(7, 2.0 if focal < 20 else 7.0, 3)):
        pixels = shadow(np.array(space.centre) + 0.2, 0.5, wide, pose) ^ shadow(np.zeros(3) - 0.4, 0.3, wide, pose)
        marked.append(Marked(pixels, wide, pose, np.full(pixels.shape, 2.2) if hidden and i % 2 else None))
    among = np.random.default_rng(0).random((64, 64, 64)) < 0.5
    found = hull(marked, space, among, 0.3, 2).ravel()
    points = centres(space, 64)
    radii = cell_radii(space, 64, points)
    chosen = np.random.default_rng(1).choice(len(points), 3000, replace=False)
    expected = np.array([among.ravel()[cell] and _meets(marked, points[cell], radii[cell]) for cell in chosen])
    assert 20 < expected.sum() < 0.9 * among.ravel()[chosen].sum()
    assert not (found[chosen] & ~expected).any()
    if focal < 20:
        assert found[chosen].sum() > 0.85 * expected.sum()
    else:
        assert np.array_equal(found[chosen], expected)


def _meets(marked: list[Marked], point: np.ndarray, radius: float) -> bool:
    against = seeing = 0
    for view in marked:
        pixel = view.camera.project((view.cam_from_object[:3, :3] @ point + view.cam_from_object[:3, 3])[None])[0]
        far = np.linalg.norm(point - camera_centre(view.cam_from_object))
        x, y = np.rint(pixel) if np.isfinite(pixel).all() else (-1, -1)
        if not (0 <= x < view.camera.width and 0 <= y < view.camera.height):
            continue
        if view.depth is not None and far - radius >= BEHIND * view.depth[int(y), int(x)]:
            continue
        seeing += 1
        rows, columns = np.nonzero(view.pixels)
        nearest = np.hypot(rows - y, columns - x).min()
        against += nearest > radius / far * view.camera.fx + SLACK_PX
    return seeing >= 2 and against <= 0.3 * seeing


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_all_that_shows_a_cell_is_drawn_from(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = np.zeros((32, 32, 32), bool)
    cells.reshape(-1)[rng.integers(0, 32**3, 40)] = True
    poses = around(3, float(rng.uniform(1.5, 5.0)), seed)
    corners = rng.random((400, 3))
    inside = from_cube(SPACE, cell_positions(rng.choice(np.flatnonzero(cells), 400), 32, corners))
    for pose, seen in zip(poses, seen_in([(CAMERA, pose) for pose in poses], SPACE, cells), strict=True):
        pixels = CAMERA.project(inside @ pose[:3, :3].T + pose[:3, 3])
        with np.errstate(invalid="ignore"):
            within = ((pixels > -0.5) & (pixels < (CAMERA.width - 0.5, CAMERA.height - 0.5))).all(axis=1)
        x, y = np.rint(pixels[within]).astype(int).T
        assert seen[y, x].all()


def plain_views(sizes: tuple[tuple[int, int], ...]) -> list[View]:
    poses = around(len(sizes), 4.0, 0)
    return [
        View(f"{i}", np.zeros((h, w, 3), np.uint8), Camera(w, h, 50.0, 50.0, w / 2, h / 2), pose)
        for i, ((h, w), pose) in enumerate(zip(sizes, poses, strict=True))
    ]


def test_pixels_are_drawn_by_the_errors_of_their_blocks() -> None:
    sizes = ((7, 9), (8, 8), (4, 13))
    blocks = Blocks(plain_views(sizes), SPACE)
    assert blocks.count == 2 * 3 + 2 * 2 + 1 * 4
    rng = np.random.default_rng(0)
    blocks.error[:] = rng.random(blocks.count, dtype=np.float32)
    blocks.reweigh()
    block, view, pixel = blocks.draw(rng, 200_000)
    for i, (h, w) in enumerate(sizes):
        assert np.array_equal(np.unique(pixel[view == i]), np.arange(h * w))
    weights = 0.5 + blocks.error / blocks.error.mean()
    share = np.bincount(block, minlength=blocks.count) / 200_000
    np.testing.assert_allclose(share, weights / weights.sum(), rtol=0.02)
    first = np.flatnonzero(view == 0)
    row, column = np.divmod(pixel[first], 9)
    assert np.array_equal(block[first], row // SIDE * 3 + column // SIDE)


def test_errors_are_remembered_and_marked_where_they_were_seen() -> None:
    blocks = Blocks(plain_views(((8, 8), (8, 12))), SPACE)
    for _ in range(30):
        blocks.learnt(np.array([1, 6]), np.array([0.5, 0.02], np.float32), np.array([2.0, 3.0], np.float32))
    first, second = blocks.wrong(0.1, np.arange(2))
    assert np.array_equal(first.pixels, [[False, True], [False, False]])
    assert not second.pixels.any()
    assert first.depth is not None
    assert first.depth[0, 1] == pytest.approx(2.0 * SPACE.scale)
    (second,) = blocks.wrong(0.01, np.array([1]))
    assert second.pixels.sum() == 1
    assert (second.camera.width, second.camera.height, second.camera.fx) == (3, 2, 50.0 / SIDE)


def test_blocks_without_an_allowed_cell_are_not_drawn_from() -> None:
    views = plain_views(((40, 40),) * 3)
    blocks = Blocks(views, SPACE)
    cells = np.zeros((32, 32, 32), bool)
    cells[14:18, 14:18, 14:18] = True
    blocks.use(SPACE, cells)
    _, view, pixel = blocks.draw(np.random.default_rng(0), 20_000)
    seen = seen_in([(v.camera, v.cam_from_object) for v in views], SPACE, cells)
    drawn = np.zeros((3, 1600), bool)
    drawn[view, pixel] = True
    grown = np.stack(seen).reshape(3, -1)
    assert drawn[grown].all()
    assert drawn.mean() < 0.5


def test_few_cells_are_looked_at_again_at_once_those_that_are_most_wrong() -> None:
    poses, image = around(12, 4.0, 5), np.zeros((44, 60, 3), np.uint8)
    blocks = Blocks([View(f"{i}", image, CAMERA, pose) for i, pose in enumerate(poses)], SPACE)
    error = blocks.error.reshape(12, 11, 15)
    error[:, 2:-2, 4:-4] = 1.0
    error[:, 5, 7] = 5.0
    empty = np.ones((32, 32, 32), bool)
    assert hull(blocks.wrong(0.9, np.arange(12)), SPACE, empty, 0.3, 3).mean() > 0.02
    found = missing(blocks, SPACE, empty, np.random.default_rng(0))
    assert 0 < len(found) <= 0.02 * empty.size
    assert np.linalg.norm(centres(SPACE, 32)[found] - SPACE.centre, axis=1).max() < 0.7


def test_a_cell_that_is_held_counts_as_empty_until_it_is_dense() -> None:
    allowed = np.ones((8, 8, 8), bool)
    allowed[0] = False
    estimate = OccupancyEstimate(SPACE, 8, allowed, np.random.default_rng(0))
    dense = np.zeros(512, bool)
    dense[100] = True
    estimate.update(lambda u: np.where((u * 8).astype(int) @ [1, 8, 64] == 100, 1e3, 0).astype(np.float32), 1.0)
    assert np.array_equal(np.flatnonzero(estimate.occupied), [100])
    estimate.hold(np.array([100, 200]))
    assert np.array_equal(np.flatnonzero(estimate.occupied), [100, 200])
    assert np.array_equal(estimate.empty.ravel(), allowed.ravel() & ~dense)


def test_looks_come_often_at_first_and_end_before_the_training_does() -> None:
    steps = [s for s in range(10_000) if due(s, s / 10_000)]
    assert steps == [512, 1024, 1536, *range(2048, 9000, 1024)]


SMALL = FieldConfig(
    levels=4, log2_table=15, finest_resolution=128, hidden=32, features=7, colour_hidden=16, occupancy_resolution=64
)
AROUND_WIRES = Space(False, (0.0, 0.0, 0.0), 1.45, step=2 / 192)


def covered(trainer: Trainer) -> float:
    """Share of the pixels with wires, rods or the body in them that the field shows, over all views."""
    renderer = NumbaRenderer(trainer.field(FieldMetadata(trainer.space, SMALL, (1.0, 1.0, 1.0), [], "test", "")))
    shown = wanted = 0
    for view in wires():
        pixels = view.image[..., 3] > 127
        shown += int((renderer.render_view(view.camera, view.cam_from_object).opacity > 0.5)[pixels].sum())
        wanted += int(pixels.sum())
    return shown / wanted


def learnt(monkeypatch: pytest.MonkeyPatch, by_silhouettes: bool, by_errors: bool, steps: int) -> float:
    """What of the wires is covered after so many steps."""
    if not by_silhouettes:
        monkeypatch.setattr(training, "silhouettes", lambda views: [])
    if not by_errors:
        monkeypatch.setattr(training, "due", lambda step, fraction: False)
    trainer = Trainer(list(wires()), AROUND_WIRES, SMALL, TrainingConfig(threads=2, samples_per_step=8000))
    for step in range(steps):
        trainer.step(step / 1500)
    return covered(trainer)


def test_wires_that_vanish_without_another_look_are_brought_back_by_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        lost = learnt(patched, by_silhouettes=False, by_errors=False, steps=1000)
    assert lost < 0.9
    with monkeypatch.context() as patched:
        assert learnt(patched, by_silhouettes=False, by_errors=True, steps=1000) > lost + 0.05


def test_wires_do_not_vanish_where_silhouettes_show_them(monkeypatch: pytest.MonkeyPatch) -> None:
    assert learnt(monkeypatch, by_silhouettes=True, by_errors=False, steps=400) > 0.93
