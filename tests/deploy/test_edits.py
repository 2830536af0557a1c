"""Each edit does to a sequence what it says, where it says, and leaves everything else as it is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import sequences

from fieldpose.deploy.evaluation import effects
from fieldpose.deploy.evaluation.edits import EDITS, described, edit_of, parameters_of
from fieldpose.deploy.evaluation.shots import LEAD_S, TAIL_S, Shot, shots_of, stretches
from fieldpose.errors import UsageError

SHOTS = shots_of(sequences.frames(120))
STEP_NS = sequences.STEP_MS * sequences.MS
OUT_OF_ORDER = {"swapped"}
WRONG_STAMPS = {"swapped", "stamps"}


def edited(name: str, seed: int = 0) -> list[Shot]:
    return EDITS[name](SHOTS, np.random.default_rng(seed))


def numbers(shots: list[Shot]) -> list[int]:
    return [shot.frame.frame_id for shot in shots]


def sources(shots: list[Shot]) -> list[int]:
    return [shot.source_id - sequences.FIRST_ID for shot in shots]


def told(shots: list[Shot]) -> list[tuple[object, ...]]:
    """All of a sequence but its pixels, and a look at one of its images."""
    facts = [(s.frame.frame_id, s.source_id, s.at_ns, s.frame.camera, s.edited) for s in shots]
    painted = [shot for shot in shots if shot.repaint is not None]
    return [*facts, *(painted[k].repaint(painted[k].frame.image)[0].tobytes() for k in (0, -1) if painted)]  # type: ignore[misc]


@pytest.mark.parametrize("name", EDITS)
def test_the_same_seed_gives_the_same_and_another_another(name: str) -> None:
    assert told(edited(name)) == told(edited(name))
    others = [told(edited(name, seed)) != told(edited(name)) for seed in range(1, 5)]
    assert any(others) == (name != "none")
    assert all(others) or name in ("none", "focal")


@pytest.mark.parametrize("name", EDITS)
def test_frames_keep_their_truth_and_are_numbered_as_they_are_sent(name: str) -> None:
    shots = edited(name)
    for shot in shots:
        assert shot.frame.truth is SHOTS[shot.source_id - sequences.FIRST_ID].frame.truth
    assert sorted(numbers(shots)) == list(range(len(shots)))
    assert (numbers(shots) == sorted(numbers(shots))) == (name not in OUT_OF_ORDER)
    steps = np.diff([shot.at_ns for shot in shots])
    assert (steps.min() > 0) == (name not in WRONG_STAMPS)


@pytest.mark.parametrize("name", ["occluder", "gone", "black", "blur", "exposure"])
def test_painting_begins_after_a_while_and_ends_before_the_end(name: str) -> None:
    shots = edited(name)
    assert [s.repaint is not None for s in shots] == [s.edited for s in shots]
    painted = [i for i, shot in enumerate(shots) if shot.edited]
    assert painted[0] >= LEAD_S * 10
    assert painted[-1] < len(shots) - TAIL_S * 10
    assert all(shot == before for shot, before in zip(shots, SHOTS, strict=True) if not shot.edited)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 4.0), st.floats(4.0, 20.0))
def test_stretches_are_as_long_as_wanted_and_apart(seed: int, seconds: float, every_s: float) -> None:
    if LEAD_S + seconds + TAIL_S > min(every_s, 11.9):
        return
    found = stretches(SHOTS, np.random.default_rng(seed), seconds, every_s)
    assert len(found) == max(1, int(11.9 / every_s))
    assert all(abs(len(stretch) - seconds * 10) <= 1 for stretch in found)
    bounds = [0, *(edge for stretch in found for edge in (stretch.start, stretch.stop)), len(SHOTS)]
    gaps = np.diff(bounds)[::2]
    assert gaps[0] >= LEAD_S * 10
    assert gaps[-1] >= TAIL_S * 10
    assert (gaps[1:-1] >= (LEAD_S + TAIL_S) * 10 - 1).all()


@pytest.mark.parametrize("name", ["occluder", "frozen", "black"])
@pytest.mark.parametrize("count", [1, 2, 20])
def test_a_part_that_is_too_short_is_told(name: str, count: int) -> None:
    with pytest.raises(UsageError, match="this edit needs"):
        EDITS[name](SHOTS[:count], np.random.default_rng(0))


def test_a_frozen_camera_repeats_a_frame_for_a_second_and_goes_on_from_there() -> None:
    shots = edited("frozen")
    assert (np.diff([shot.at_ns for shot in shots]) == STEP_NS).all()
    repeats = [i for i, shot in enumerate(shots) if shot.edited]
    assert repeats == list(range(repeats[0], repeats[0] + 10))
    assert sources(shots) == [*range(repeats[0]), *[repeats[0] - 1] * 10, *range(repeats[0], len(SHOTS))]


def test_half_of_the_frames_are_missing_and_the_rest_keep_their_stamps() -> None:
    shots = edited("missing")
    assert abs(len(shots) - len(SHOTS) / 2) <= 8
    gaps = np.diff(sources(shots))
    assert 5 <= gaps.max() <= 9
    assert [shot.edited for shot in shots[1:]] == (gaps > 1).tolist()
    assert all(shot.at_ns == SHOTS[i].at_ns for shot, i in zip(shots, sources(shots), strict=True))


def test_cuts_jump_to_other_places_while_stamps_run_on() -> None:
    shots = edited("cut")
    assert sorted(sources(shots)) == list(range(len(SHOTS)))
    jumps = np.diff(sources(shots))
    assert (jumps != 1).sum() == 2
    assert np.abs(jumps).max() > len(SHOTS) / 5
    assert [shot.edited for shot in shots[1:]] == (jumps != 1).tolist()
    assert (np.diff([shot.at_ns for shot in shots]) == STEP_NS).all()


def test_swapped_frames_change_places_with_a_neighbour_and_keep_number_and_stamp() -> None:
    shots = edited("swapped")
    assert sources(shots) == numbers(shots)
    assert sorted(shots, key=lambda shot: shot.at_ns) == sorted(shots, key=lambda shot: shot.frame.frame_id)
    moved = np.array(numbers(shots)) - np.arange(len(shots))
    assert set(moved.tolist()) == {-1, 0, 1}
    assert [shot.edited for shot in shots] == (moved != 0).tolist()
    assert 4 <= (moved == 1).sum() <= 24


def test_stamps_are_jittered_and_now_and_then_equal_or_earlier() -> None:
    shots = edited("stamps")
    off_ms = np.array([shot.at_ns - before.at_ns for shot, before in zip(shots, SHOTS, strict=True)]) / 1e6
    steps = np.diff([shot.at_ns for shot in shots])
    assert (steps == 0).any()
    assert (steps < 0).any()
    assert (np.abs(off_ms) <= 20).mean() > 0.8
    assert np.abs(off_ms).max() <= 20 + 20 + sequences.STEP_MS
    assert np.ptp(off_ms) > 30


def test_focal_lengths_are_wrong_in_the_camera_alone() -> None:
    factors = set()
    for seed in range(4):
        shots = edited("focal", seed)
        cameras = {shot.frame.camera for shot in shots}
        assert len(cameras) == 1
        camera = cameras.pop()
        factors.add(round(camera.fx / sequences.CAMERA.fx, 6))
        assert camera.fy / camera.fx == sequences.CAMERA.fy / sequences.CAMERA.fx
        assert (camera.cx, camera.cy) == (sequences.CAMERA.cx, sequences.CAMERA.cy)
        assert all(shot.repaint is None for shot in shots)
    assert factors == {0.95, 1.05}


def test_an_occluder_grows_to_what_it_is_to_cover_then_leaves() -> None:
    image = cv2.resize(sequences.image(0), (320, 240))
    thing = effects.Occluder.drawn(np.random.default_rng(3), 0.8, grow_s=2.0, stay_s=1.0, leave_s=1.0)
    visible = []
    for seconds in np.linspace(0, 4, 17):
        covered, share = thing(seconds, image)
        visible.append(share)
        assert (covered != image).any(axis=2).mean() == pytest.approx(1 - share, abs=0.03)
    assert visible[0] == pytest.approx(1, abs=0.001)
    np.testing.assert_allclose(visible[8:13], 0.2, atol=0.005)
    assert (np.diff(visible[:9]) < 0).all()
    assert (np.diff(visible[12:]) >= 0).all()
    assert visible[-1] == 1.0
    np.testing.assert_array_equal(thing(4.0, image)[0], image)


def test_another_place_has_the_look_of_the_scene_but_not_its_content() -> None:
    image = cv2.resize(sequences.image(0), (160, 120))
    place = effects.Elsewhere(seed=5, towards=1.0)
    other, share = place(0.0, image)
    assert (other.shape, other.dtype, share) == (image.shape, np.uint8, 0.0)
    np.testing.assert_allclose(other.mean(axis=(0, 1)), image.mean(axis=(0, 1)), atol=60)
    assert abs(np.corrcoef(other.ravel(), image.ravel())[0, 1]) < 0.5
    later = place(0.5, image)[0]
    assert (later != other).any()


@pytest.mark.parametrize(("angle_deg", "extent"), [(0, (1, 15)), (90, (15, 1))])
def test_motion_blur_is_a_line_of_the_wanted_length(angle_deg: float, extent: tuple[int, int]) -> None:
    point = np.zeros((41, 41, 3), np.uint8)
    point[20, 20] = 255
    streak, share = effects.streaked(15, angle_deg, 0.0, point)
    rows, columns = np.nonzero(streak[..., 0] > 5)
    assert (np.ptp(rows) + 1, np.ptp(columns) + 1) == extent
    assert streak[..., 0].sum() == pytest.approx(255, abs=10)
    assert share == 1.0


def light(image: np.ndarray) -> float:
    return float(((image / 255) ** effects.GAMMA).mean())


def test_gains_are_of_light_and_follow_one_another() -> None:
    grey = np.full((4, 4, 3), 120, np.uint8)
    stepped = [effects.stepped((0.5, 2.0), 1.0, seconds, grey)[0] for seconds in (0.0, 0.9, 1.1, 2.0)]
    gains = [light(image) / light(grey) for image in stepped]
    np.testing.assert_allclose(gains, [0.5, 0.5, 2.0, 2.0], rtol=0.02)
    assert effects.stepped((9.0,), 1.0, 0.0, grey)[0].max() == 255


def test_lamps_flicker_from_frame_to_frame() -> None:
    grey = np.full((4, 4, 3), 120, np.uint8)
    gains = [light(effects.flickering(0.4, 100.0, 0.0, k / 30, grey)[0]) / light(grey) for k in range(6)]
    np.testing.assert_allclose(gains[:3], 1 + 0.4 * np.sin(np.array([0, 2, 4]) * np.pi / 3), rtol=0.02)
    np.testing.assert_allclose(gains[3:], gains[:3], rtol=0.001)


def test_an_edit_is_found_by_its_name_and_near_names_are_told() -> None:
    assert edit_of("blur") is EDITS["blur"]
    with pytest.raises(UsageError, match=r"edit 'ocluder': did you mean occluder\?"):
        edit_of("ocluder")
    with pytest.raises(UsageError, match=", ".join(EDITS)):
        edit_of("xyz")


def test_every_edit_says_what_it_does_and_with_which_numbers() -> None:
    assert all(f"{name}: " in described() for name in EDITS)
    assert parameters_of(EDITS["black"]) == {"seconds": 0.5, "every_s": 10.0}
