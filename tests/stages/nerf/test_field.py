"""Field files: what is saved comes back, anything else is refused with one line."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file, save_file

from fieldpose.errors import FieldFileError
from fieldpose.stages.geometry import Camera, look_at
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import Field, grid_layout, load_field, new_net
from fieldpose.stages.nerf.metadata import FieldMetadata, Space, TrainingCamera
from fieldpose.stages.nerf.occupancy import from_cube, seen_by_cameras
from fieldpose.stages.nerf.twin import TwinField

CONFIG = FieldConfig(levels=3, log2_table=8, hidden=8, features=4, colour_hidden=8, occupancy_resolution=16)


@pytest.fixture
def field() -> Field:
    rng = np.random.default_rng(0)
    metadata = FieldMetadata(Space(True, (1.0, 2.0, 3.0), 0.5), CONFIG, (1.0, 1.0, 1.0), [], "test", "ab")
    return Field(metadata, new_net(CONFIG, rng), rng.random((16, 16, 16)) < 0.3)


def test_round_trip(field: Field, tmp_path: Path) -> None:
    field.save(tmp_path / "f.safetensors")
    back = load_field(tmp_path / "f.safetensors")
    assert back.metadata == field.metadata
    np.testing.assert_array_equal(back.occupied, field.occupied)
    np.testing.assert_array_equal(back.net.w1, field.net.w1)
    np.testing.assert_allclose(back.net.table, field.net.table, atol=1e-6, rtol=1e-3)
    assert [p.name for p in tmp_path.iterdir()] == ["f.safetensors"]
    (tmp_path / "other").touch()
    assert (tmp_path / "f.safetensors").stat().st_mode == (tmp_path / "other").stat().st_mode


def refusal(path: Path) -> str:
    with pytest.raises(FieldFileError) as caught:
        load_field(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


def test_what_is_no_field_is_refused(field: Field, tmp_path: Path) -> None:
    path = tmp_path / "f.safetensors"
    assert "no such field file" in refusal(path)
    path.write_text("just text, no field")
    assert "not a safetensors field file" in refusal(path)
    field.save(path)
    path.write_bytes(path.read_bytes()[:-100])
    assert "not a safetensors field file" in refusal(path)


def test_another_version_and_damage_are_refused(field: Field, tmp_path: Path) -> None:
    path = tmp_path / "f.safetensors"
    field.save(path)
    arrays = load_file(path)
    save_file(arrays, path, metadata={"fieldpose": "{}", "version": "99"})
    assert "version 99" in refusal(path)
    save_file(arrays, path, metadata={"fieldpose": "{}", "version": "1"})
    assert "damaged" in refusal(path)
    save_file(arrays, path)
    assert "version none" in refusal(path)


def test_wrong_arrays_are_refused(field: Field, tmp_path: Path) -> None:
    path = tmp_path / "f.safetensors"
    field.net.w1[0, 0] = np.nan
    field.save(path)
    assert "w1" in refusal(path)


def test_how_the_training_views_look_is_kept_and_checked(field: Field, tmp_path: Path) -> None:
    camera = TrainingCamera("a", 4, 4, 4.0, 4.0, 1.5, 1.5, (0.0,) * 5, tuple(np.eye(4).ravel().tolist()))
    field.metadata = msgspec.structs.replace(field.metadata, cameras=[camera, camera])
    path = tmp_path / "f.safetensors"
    field.save(path)
    assert load_field(path).descriptors is None
    field.descriptors = np.random.default_rng(0).integers(-127, 128, (2, 5, 64), np.int8)
    field.save(path)
    np.testing.assert_array_equal(load_field(path).descriptors, field.descriptors)
    for wrong in (field.descriptors[:1], field.descriptors[..., :32], field.descriptors.astype(np.int16)):
        field.descriptors = wrong
        field.save(path)
        assert "descriptors" in refusal(path)


@given(levels=st.integers(1, 8), log2_table=st.integers(4, 14), base=st.integers(2, 20), finest=st.integers(20, 200))
@settings(max_examples=30, deadline=None)
def test_every_cell_has_rows_of_its_own_level(levels: int, log2_table: int, base: int, finest: int) -> None:
    config = FieldConfig(levels=levels, log2_table=log2_table, base_resolution=base, finest_resolution=finest)
    offsets, resolutions, masks, entries = grid_layout(config)
    sizes = np.diff([*offsets, entries])
    for resolution, mask, size in zip(resolutions, masks, sizes, strict=True):
        assert size == ((resolution + 1) ** 3 if mask < 0 else mask + 1)
        assert size <= 1 << log2_table


@given(st.lists(st.floats(-30, 30), min_size=3, max_size=3))
def test_the_cube_and_back(y: list[float]) -> None:
    space = Space(True, (1.0, -2.0, 0.5), 2.0)
    config = FieldConfig(levels=1, log2_table=4, occupancy_resolution=8)
    twin = TwinField(new_net(config, np.random.default_rng(0)), space, np.ones((8, 8, 8), bool))
    import torch

    u, _ = twin.to_cube(torch.tensor([y], dtype=torch.float64))
    assert np.all((u.numpy() > 0) & (u.numpy() < 1))
    point = np.array(y) * space.scale + space.centre
    np.testing.assert_allclose(from_cube(space, u.numpy())[0], point, rtol=1e-6, atol=1e-6)


def test_cells_behind_and_beside_the_camera_are_not_seen() -> None:
    camera = Camera(32, 32, 32.0, 32.0, 15.5, 15.5)
    pose = look_at(np.array([0, 0, -3.0]), np.zeros(3), np.array([0, 1.0, 0]))
    seen = seen_by_cameras(Space(False, (0.0, 0.0, 0.0), 4.0), 32, [(camera, pose)])
    assert seen[16, 16, 16]
    assert not seen[:4].any()
    assert not seen[16, 16, 0]
