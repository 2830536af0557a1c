"""Frames chosen by how the picture moved and how sharp it is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.pictures import picture

from fieldpose.stages.structure.selection import FEWEST, STRIDE, Candidate, Chooser, Measured, Meter, sharpness, thinned

SIDE = 320
WIDE = picture(0, 900)


def seen_from(x: float, y: float = 100.0, blur: float = 0.0) -> np.ndarray:
    """A window onto a large picture, as a camera that glides along it has it."""
    shift = np.array([[1.0, 0, -x], [0, 1.0, -y]])
    image = cv2.warpAffine(WIDE, shift, (SIDE, 240))
    return cv2.GaussianBlur(image, (0, 0), blur) if blur else image


def test_the_way_is_how_far_the_picture_moved() -> None:
    meter, at = Meter(), 100.0
    assert meter(seen_from(at)).moved == 0
    for step in (0.0, 1.5, 4.0, 12.0):
        at += step
        assert meter(seen_from(at)).moved == pytest.approx(step / SIDE, abs=0.2 / SIDE)


def test_a_cut_and_a_frame_of_another_size_count_as_moved() -> None:
    meter = Meter()
    meter(seen_from(100))
    assert meter(np.zeros((240, SIDE, 3), np.uint8)).moved > STRIDE
    assert meter(seen_from(100)[:120]).moved > STRIDE


@pytest.mark.parametrize("contrast", [0.5, 0.8])
def test_blur_is_seen_and_contrast_is_not(contrast: float) -> None:
    grey = cv2.cvtColor(seen_from(150), cv2.COLOR_RGB2GRAY)
    sharp = sharpness(grey)
    assert sharpness((grey * contrast).astype(np.uint8)) == pytest.approx(sharp, rel=0.1)
    blurred = [sharpness(cv2.GaussianBlur(grey, (0, 0), sigma)) for sigma in (1.0, 2.0, 3.0)]
    assert sharp > blurred[0] > blurred[1] > blurred[2]
    assert blurred[1] < 0.6 * sharp


def take(chooser: Chooser[int], measured: list[Measured]) -> None:
    for number, one in enumerate(measured):
        if chooser.wants(one):
            chooser.keep(one, number)


def test_the_sharpest_frame_of_each_part_of_the_way_is_chosen_and_rest_adds_none() -> None:
    meter, chooser = Meter(), Chooser[int](100)
    places = [100.0] * 10 + list(np.arange(100.0, 100 + 8 * STRIDE * SIDE, STRIDE * SIDE / 16))
    take(chooser, [meter(seen_from(x, blur=0.0 if n % 2 else 1.2)) for n, x in enumerate(places)])
    chosen, blurred = chooser.chosen()
    assert chooser.seen == len(places)
    assert 0.8 * FEWEST <= len(chosen) + len(blurred) <= FEWEST
    assert all(candidate.payload == candidate.number and candidate.number % 2 for candidate in chosen)
    assert sum(candidate.number < 10 for candidate in chosen + blurred) == 1


def test_frames_of_a_long_way_are_a_stride_apart_and_few_are_held() -> None:
    chooser = Chooser[int](60)
    take(chooser, [Measured(STRIDE / 3, 1 + np.sin(i)) for i in range(3000)])
    chosen, _ = chooser.chosen()
    assert 50 <= len(chosen) <= 60
    assert len(chooser._kept) <= 240
    assert np.diff([c.number for c in chosen]).max() <= 2 * 3000 / 60
    short = Chooser[int](150)
    take(short, [Measured(STRIDE / 3, 1.0) for i in range(300)])
    assert 90 <= len(short.chosen()[0]) <= 101


def test_a_part_without_a_sharp_frame_is_left_out() -> None:
    chooser = Chooser[int](100)
    take(chooser, [Measured(1.01 * STRIDE, 0.2 if i == 7 else 1.0) for i in range(20)])
    chosen, blurred = chooser.chosen()
    assert [c.payload for c in blurred] == [7]
    assert [c.payload for c in chosen] == [*range(7), *range(8, 20)]


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0.1, 1)), min_size=1, max_size=60), st.integers(1, 40))
def test_thinning_keeps_the_order_and_at_most_so_many(steps: list[tuple[float, float]], most: int) -> None:
    way = np.cumsum([step for step, _ in steps])
    kept = [Candidate(i, sharp, float(way[i]), i) for i, (_, sharp) in enumerate(steps)]
    left = thinned(kept, most)
    numbers = [candidate.number for candidate in left]
    assert numbers == sorted(set(numbers))
    assert 1 <= len(left) <= max(most, 1)
    if len(kept) <= most:
        assert left == kept
    assert max(kept, key=lambda c: c.sharpness).sharpness == max(left, key=lambda c: c.sharpness).sharpness
