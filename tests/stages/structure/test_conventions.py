"""Poses that were written in other axes than they are read in are found out by their images."""

from __future__ import annotations

import numpy as np
import pytest
from support.papered_room import cameras_before_a_wall, photograph

from fieldpose.deploy.cameras import in_words
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.metadata import CameraFit
from fieldpose.stages.structure.conventions import READINGS
from fieldpose.stages.structure.mending import mend
from fieldpose.stages.structure.posed import PosedCameras

CAMERA = Camera(480, 360, 330.0, 330.0, 239.5, 179.5)
TRUTH = cameras_before_a_wall(CAMERA, 9)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [photograph(CAMERA, pose) for pose in TRUTH.cam_from_object]


def as_read(stored: np.ndarray) -> np.ndarray:
    """cam_from_object from stored matrices, taken for object_from_cam in OpenGL's axes."""
    return FLIP @ np.linalg.inv(stored)


WRITTEN = dict(
    zip(
        READINGS,
        (
            np.linalg.inv(TRUTH.cam_from_object),
            TRUTH.cam_from_object,
            FLIP @ TRUTH.cam_from_object,
        ),
        strict=True,
    )
)


@pytest.mark.parametrize("name", list(READINGS))
def test_how_poses_were_meant_is_found(name: str, images: list[np.ndarray]) -> None:
    read = as_read(WRITTEN[name])
    np.testing.assert_allclose(READINGS[name](read), TRUTH.cam_from_object, atol=1e-9)
    found = mend(PosedCameras(TRUTH.cameras, read), lambda index, width, height: images[index], threads=2)
    assert found.verdict in ("no fit", "too few")
    assert found.reading == name
    told = in_words(CameraFit(found.verdict, 480, (330.0, 330.0), reading=found.reading), "m")
    assert "do not fit" in told
    assert name in told


def test_poses_of_other_images_are_none_of_these(images: list[np.ndarray]) -> None:
    shuffled = PosedCameras(TRUTH.cameras, TRUTH.cam_from_object[[4, 0, 6, 2, 8, 1, 3, 5, 7]])
    found = mend(shuffled, lambda index, width, height: images[index], threads=2)
    assert found.reading is None
