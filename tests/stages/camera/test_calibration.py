"""Which camera took an image: what decides, in which order, and what contradicts the training views."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from fieldpose.bus.messages import CameraOrigin
from fieldpose.errors import SourceError
from fieldpose.stages.camera.calibration import Calibration, Calibrator
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.geometry import Camera

WIDTH, HEIGHT = 48, 32
EXIF_MM, EXIF_FOCAL = 30, 40.0
LANDSCAPE = Camera(96, 64, 84.0, 85.0, 47.0, 32.0, (0.1, 0.0, 0.0, 0.0, 0.0))
PORTRAIT = Camera(64, 96, 70.0, 71.0, 31.0, 48.0)


def photo(path: Path, focal_mm: int | None = None, width: int = WIDTH, height: int = HEIGHT) -> Path:
    """An image file, whose EXIF may tell a focal length."""
    exif = Image.Exif()
    if focal_mm is not None:
        exif.get_ifd(0x8769)[0xA405] = focal_mm
    Image.new("RGB", (width, height)).save(path, exif=exif)
    return path


def of(known: tuple[Camera, ...] = (), image: Path | None = None, **config: object) -> Calibration:
    """The calibration of an image of WIDTH x HEIGHT."""
    calibrator = Calibrator(CameraConfig("folder:x", **config), known)  # type: ignore[arg-type]
    return calibrator.of(WIDTH, HEIGHT, image)


def with_focal(focal: float) -> Camera:
    """A training camera whose focal length is that for images of WIDTH x HEIGHT."""
    return Camera(2 * WIDTH, 2 * HEIGHT, 2 * focal, 2 * focal, WIDTH - 0.5, HEIGHT - 0.5)


def test_first_the_file_decides_then_the_training_views_then_exif_then_the_field_of_view(tmp_path: Path) -> None:
    file, told = tmp_path / "camera.json", photo(tmp_path / "told.jpg", EXIF_MM)
    file.write_bytes(msgspec.json.encode(Camera(WIDTH, HEIGHT, 20.0, 21.0, 23.0, 15.0)))
    silent, known = photo(tmp_path / "silent.jpg"), (LANDSCAPE,)
    found = [
        of(known, told, camera_file=file),
        of(known, told),
        of((), told),
        of((), silent, fov_deg=90.0),
    ]
    origins = [CameraOrigin.CALIBRATED, CameraOrigin.TRAINING, CameraOrigin.EXIF, CameraOrigin.ASSUMED]
    assert [calibration.origin for calibration in found] == origins
    assert [calibration.camera.fx for calibration in found] == pytest.approx([20.0, 42.0, EXIF_FOCAL, 24.0])


def test_images_that_tell_nothing_are_taken_with_the_training_camera(tmp_path: Path) -> None:
    for image in (None, photo(tmp_path / "silent.jpg"), photo(tmp_path / "silent.png"), tmp_path / "none.jpg"):
        calibration = of((LANDSCAPE,), image)
        assert calibration.origin is CameraOrigin.TRAINING
        assert calibration.camera == LANDSCAPE.resized(WIDTH, HEIGHT)
        assert calibration.camera.distortion == LANDSCAPE.distortion
        assert "training views" in calibration.told


@pytest.mark.parametrize("times", [1 / 1.19, 0.95, 1.0, 1.05, 1.19])
def test_exif_that_nearly_agrees_leaves_the_training_camera(tmp_path: Path, times: float) -> None:
    calibration = of((with_focal(times * EXIF_FOCAL),), photo(tmp_path / "a.jpg", EXIF_MM))
    assert calibration.origin is CameraOrigin.TRAINING
    assert calibration.camera.fx == pytest.approx(times * EXIF_FOCAL)


@pytest.mark.parametrize("times", [0.5, 1 / 1.21, 1.21, 2.0])
def test_exif_of_another_lens_overrules_the_training_camera(tmp_path: Path, times: float) -> None:
    calibration = of((with_focal(times * EXIF_FOCAL),), photo(tmp_path / "a.jpg", EXIF_MM))
    assert calibration.origin is CameraOrigin.EXIF
    camera = calibration.camera
    assert (camera.fx, camera.fy) == (pytest.approx(EXIF_FOCAL), pytest.approx(EXIF_FOCAL))
    assert (camera.width, camera.height, camera.cx, camera.cy) == (WIDTH, HEIGHT, 23.5, 15.5)
    assert "EXIF" in calibration.told


def test_exif_of_no_focal_length_says_nothing(tmp_path: Path) -> None:
    assert of((LANDSCAPE,), photo(tmp_path / "a.jpg", 0)).origin is CameraOrigin.TRAINING
    assert of((), photo(tmp_path / "a.jpg", 0)).origin is CameraOrigin.ASSUMED


@pytest.mark.parametrize(("width", "height", "known"), [(48, 32, LANDSCAPE), (32, 48, PORTRAIT), (320, 480, PORTRAIT)])
def test_of_landscape_and_portrait_training_cameras_the_one_of_the_images_shape_counts(
    width: int, height: int, known: Camera
) -> None:
    for cameras in ((LANDSCAPE, PORTRAIT), (PORTRAIT, LANDSCAPE)):
        calibration = Calibrator(CameraConfig("folder:x"), cameras).of(width, height)
        assert calibration.origin is CameraOrigin.TRAINING
        assert calibration.camera == known.resized(width, height)


@pytest.mark.parametrize(("width", "height"), [(32, 48), (40, 32), (32, 32)])
def test_a_training_camera_of_another_shape_says_nothing(tmp_path: Path, width: int, height: int) -> None:
    calibrator = Calibrator(CameraConfig("folder:x", fov_deg=90.0), (LANDSCAPE,))
    assumed = calibrator.of(width, height)
    assert assumed.origin is CameraOrigin.ASSUMED
    assert assumed.camera.fx == pytest.approx(max(width, height) / 2)
    told = calibrator.of(width, height, photo(tmp_path / "a.jpg", EXIF_MM, width, height))
    assert told.origin is CameraOrigin.EXIF


def test_a_shape_that_is_off_by_rounding_is_the_same() -> None:
    small = Camera(400, 267, 350.0, 350.0, 199.5, 133.0)
    calibration = Calibrator(CameraConfig("folder:x"), (small,)).of(6000, 4000)
    assert calibration.origin is CameraOrigin.TRAINING
    assert calibration.camera == small.resized(6000, 4000)


@given(st.permutations([30.0, 41.0, 44.0, 46.0, 90.0]))
def test_of_several_training_cameras_the_median_counts(focal_lengths: list[float]) -> None:
    calibration = of(tuple(with_focal(focal) for focal in focal_lengths))
    assert calibration.camera.fx == pytest.approx(44.0)


@given(st.floats(1.0, 170.0), st.integers(1, 4000), st.integers(1, 4000))
def test_an_assumed_field_of_view_is_that_of_the_longer_side(fov_deg: float, width: int, height: int) -> None:
    calibration = Calibrator(CameraConfig("folder:x", fov_deg=fov_deg)).of(width, height)
    camera = calibration.camera
    seen = 2 * np.rad2deg(np.arctan(max(width, height) / 2 / camera.fx))
    assert (camera.fx, seen) == (camera.fy, pytest.approx(fov_deg))
    assert (camera.cx, camera.cy) == ((width - 1) / 2, (height - 1) / 2)
    assert calibration.origin is CameraOrigin.ASSUMED
    assert f"{fov_deg:g} degrees" in calibration.told
    assert "--camera.camera-file" in calibration.told


def test_a_camera_file_of_another_shape_is_refused_even_where_a_training_camera_fits(tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    file.write_bytes(msgspec.json.encode(PORTRAIT))
    with pytest.raises(SourceError, match="another shape"):
        of((LANDSCAPE,), camera_file=file)
