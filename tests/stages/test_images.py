import cv2
import numpy as np
import pytest
from support.pictures import picture

from fieldpose.stages.geometry import Camera
from fieldpose.stages.images import decoded, shrunk, shrunk_with_camera

CAMERA = Camera(64, 64, 70.0, 70.0, 30.3, 33.1)


def test_images_are_averaged_over_areas_and_never_enlarged() -> None:
    image = picture(0, 64)
    assert shrunk(image, 64) is image
    half = shrunk(image, 32)
    np.testing.assert_allclose(half, image.reshape(32, 2, 32, 2, 3).mean(axis=(1, 3)), atol=1)
    assert shrunk(image[:20, :, 0], 32).shape == (10, 32)


@pytest.mark.parametrize("longer_side", [None, 64, 100])
def test_an_image_that_is_small_enough_keeps_its_camera(longer_side: int | None) -> None:
    image = picture(0, 64)
    same, camera = shrunk_with_camera(image, CAMERA, longer_side)
    assert same is image
    assert camera is CAMERA


def test_an_image_and_its_camera_shrink_together() -> None:
    small, camera = shrunk_with_camera(picture(0, 64)[:48], Camera(64, 48, 70.0, 70.0, 30.0, 20.0), 20)
    assert small.shape == (15, 20, 3)
    assert (camera.width, camera.height) == (20, 15)


def test_encoded_images_are_decoded_to_rgb_at_their_size_or_not_at_all() -> None:
    image = picture(0, 64)[:48]
    png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].ravel()
    np.testing.assert_array_equal(decoded("png", png, 64, 48), image)
    assert decoded("rgb8", image, 64, 48) is image
    assert decoded("png", png, 48, 64) is None
    assert decoded("png", png[:30], 64, 48) is None
    assert decoded("jpeg", np.zeros(0, np.uint8), 64, 48) is None
