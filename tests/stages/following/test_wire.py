"""Frames as they come over the bus, shrunk to grey values for following."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.chain import frame_message, over_the_wire
from support.pictures import picture

from fieldpose.bus.messages import Frame
from fieldpose.bus.topics import FRAME
from fieldpose.stages.following.config import LEVELS
from fieldpose.stages.following.core import Followed
from fieldpose.stages.following.wire import in_frame, small_frame
from fieldpose.stages.geometry import Camera

WIDTH, HEIGHT = 400, 304
LENS = Camera(WIDTH, HEIGHT, 380.0, 380.0, 199.5, 151.5, (-0.1, 0.02, 0.0, 0.0, 0.0))
IMAGE = cv2.GaussianBlur(picture(3, WIDTH)[:HEIGHT], (0, 0), 2.0)
ENCODINGS = ("rgb8", "jpeg", "png")


def encoded(encoding: str, image: np.ndarray = IMAGE) -> np.ndarray:
    if encoding == "rgb8":
        return image
    suffix, bgr = {"jpeg": ".jpg", "png": ".png"}[encoding], cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(suffix, bgr)[1].ravel()


def frame(encoding: Any, image: np.ndarray | None = None, camera: Camera = LENS) -> Frame:
    """As a receiver has it, with a read-only image."""
    message = frame_message(encoded(encoding) if image is None else image, camera, encoding=encoding)
    received = over_the_wire(FRAME, message)
    assert isinstance(received, Frame)
    return received


def whole(longer_side: int) -> np.ndarray:
    """What the image is if all of it is decoded and shrunk, (h, w) float64."""
    small = LENS.shrunk(longer_side)
    grey = cv2.cvtColor(IMAGE, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, (small.width, small.height), interpolation=cv2.INTER_AREA).astype(np.float64)


def shift_px(values: np.ndarray, there: np.ndarray, axis: int) -> float:
    """How far the second image is shifted along an axis, by its differences and the slopes of the first."""
    slopes = np.gradient(values, axis=axis)
    return float(((values - there) * slopes).sum() / (slopes**2).sum())


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("longer_side", [1000, 400, 399, 201, 200, 150, 100, 64, 50, 30])
def test_grey_values_are_those_of_the_whole_image_shrunk(encoding: str, longer_side: int) -> None:
    """Although a JPEG file is decoded no larger than it need be."""
    small, expected = small_frame(frame(encoding), longer_side), whole(longer_side)
    assert small is not None
    assert small.camera == LENS.shrunk(longer_side)
    np.testing.assert_array_equal(small.scale, [1.0, 1.0])
    assert small.levels[0].shape == expected.shape == (small.camera.height, small.camera.width)
    assert len(small.levels) == LEVELS
    assert np.abs(small.levels[0] * 255 - expected).mean() < 2.5


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("longer_side", [400, 200, 150, 100, 50])
def test_the_image_is_shifted_nowhere_by_how_it_is_decoded(encoding: str, longer_side: int) -> None:
    """Neither at its ends nor between them."""
    small, expected = small_frame(frame(encoding), longer_side), whole(longer_side)
    assert small is not None
    values, part = small.levels[0] * 255.0, longer_side // 6
    for axis, parts in ((1, np.s_[:, :part]), (1, np.s_[:, -part:]), (0, np.s_[:part]), (0, np.s_[-part:])):
        assert abs(shift_px(expected[parts], values[parts], axis)) < 0.06
    assert abs(shift_px(expected, values, 0)) < 0.03
    assert abs(shift_px(expected, values, 1)) < 0.03


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("size", [(401, 300), (399, 299), (300, 401), (97, 61)])
@pytest.mark.parametrize("longer_side", [200, 100, 48, 12])
def test_any_size_of_image_is_taken(encoding: str, size: tuple[int, int], longer_side: int) -> None:
    camera = Camera(*size, 380.0, 380.0, size[0] / 2, size[1] / 2)
    small = small_frame(frame(encoding, encoded(encoding, cv2.resize(IMAGE, size)), camera), longer_side)
    assert small is not None
    assert small.camera == camera.shrunk(longer_side)
    assert small.levels[0].shape == (small.camera.height, small.camera.width)


@pytest.mark.parametrize("encoding", ["jpeg", "png"])
@pytest.mark.parametrize("longer_side", [400, 200, 50])
def test_an_image_of_another_size_than_its_camera_is_none(encoding: str, longer_side: int) -> None:
    for width, height in ((WIDTH + 16, HEIGHT), (WIDTH, HEIGHT - 16), (HEIGHT, WIDTH), (2 * WIDTH, 2 * HEIGHT)):
        other = Camera(width, height, 380.0, 380.0, width / 2, height / 2)
        assert small_frame(frame(encoding, camera=other), longer_side) is None


@pytest.mark.parametrize("encoding", ["jpeg", "png"])
@pytest.mark.parametrize("content", [b"", b"\0", b"no image", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"])
def test_bytes_that_are_no_image_are_none(encoding: str, content: bytes) -> None:
    assert small_frame(frame(encoding, np.frombuffer(content, np.uint8)), 200) is None


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    encoding=st.sampled_from(["jpeg", "png"]),
    longer_side=st.sampled_from([400, 200, 50]),
    changes=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=8),
    kept=st.floats(0, 1),
)
def test_damaged_files_are_none_or_an_image_of_the_right_size(
    encoding: str, longer_side: int, changes: list[tuple[float, int]], kept: float
) -> None:
    content = encoded(encoding).copy()
    for where, value in changes:
        content[int(where * (len(content) - 1))] = value
    small = small_frame(frame(encoding, content[: int(np.ceil(kept * len(content)))]), longer_side)
    assert small is None or small.levels[0].shape == (small.camera.height, small.camera.width)
    assert small is None or small.camera == LENS.shrunk(longer_side)


@pytest.mark.parametrize("longer_side", [200, 100])
def test_pixels_of_the_shrunk_image_are_told_in_the_frames(longer_side: int) -> None:
    """The middle of a pixel of the one is the middle of an area of the other, and corners are corners."""
    small = LENS.shrunk(longer_side)
    corners = np.array([[-0.5, -0.5], [small.width - 0.5, small.height - 0.5]], np.float32)
    points = np.array([[0.3, 0.1, 2.0], [-0.4, 0.2, 3.0]])
    pixels = np.concatenate([corners, small.project(points)]).astype(np.float32)
    unknown = np.eye(6)
    followed = Followed(
        np.eye(4), unknown, unknown, longer_side, pixels, np.ones(len(pixels), bool), 1.0, 0, 0.0, 0.0, 1.0
    )  # fmt: skip
    there = in_frame(followed, LENS)
    assert there.dtype == np.float32
    np.testing.assert_allclose(there[:2], [[-0.5, -0.5], [WIDTH - 0.5, HEIGHT - 0.5]], atol=1e-4)
    np.testing.assert_allclose(there[2:], LENS.project(points), atol=1e-3)
