"""What --guess may say, the policies it makes, and the poses to fall back on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fieldpose.stages.tracking.frame_policies import EachFramePolicy, PerturbedTruthPolicy
from fieldpose.stages.tracking.guesses import make_policy, needs_truth, start_pose
from fieldpose.stages.tracking.retrieved import RetrievedPoses
from fieldpose.stages.tracking.track_policy import TrackPolicy
from fieldpose.stages.tracking.views import Keyframes, Relocaliser, TrainingViews, farthest_point_order, nearest_first
from support.tracking_world import on_sphere, ring_of_views

from fieldpose.bus.messages import GuessReason, TrackingState
from fieldpose.errors import ConfigError, DatasetError
from fieldpose.stages.geometry import Limit, pairwise, rotation_error_deg, translation_error
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.policy import Attempt, FrameInfo, PoseResult

VIEWS = ring_of_views()
FRAME = FrameInfo(7, 0)


def write(path: Path, content: object) -> str:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return str(path)


def test_a_training_view_is_found_by_its_name_or_the_end_of_it() -> None:
    np.testing.assert_array_equal(start_pose("train:r_3", VIEWS), VIEWS.cam_from_object[3])
    guess = make_policy(TrackingConfig(guess="train:train/r_5.png"), VIEWS).first_guess(FRAME)
    assert guess is not None
    np.testing.assert_array_equal(guess.cam_from_object, VIEWS.cam_from_object[5])


def test_a_training_view_that_does_not_exist_is_an_error() -> None:
    with pytest.raises(DatasetError, match="r_99"):
        start_pose("train:r_99", VIEWS)
    with pytest.raises(ConfigError, match="does not tell"):
        start_pose("train:r_1", TrainingViews((), np.zeros((0, 4, 4))))


def test_a_file_with_one_pose_starts_the_track(tmp_path: Path) -> None:
    pose = on_sphere(40, 20)
    spec = write(tmp_path / "guess.json", {"cam_from_object": pose.tolist()})
    policy = make_policy(TrackingConfig(guess=spec), VIEWS)
    assert isinstance(policy, TrackPolicy)
    guess = policy.first_guess(FRAME)
    assert guess is not None
    assert guess.reason is GuessReason.PRIOR
    np.testing.assert_allclose(guess.cam_from_object, pose, atol=1e-9)


def test_a_file_with_a_pose_for_each_frame_gives_each_its_own(tmp_path: Path) -> None:
    poses = {str(i): on_sphere(10 * i, 20).tolist() for i in (7, 8)}
    policy = make_policy(TrackingConfig(guess=write(tmp_path / "guesses.json", {"frames": poses})), VIEWS)
    guess = policy.first_guess(FRAME)
    assert guess is not None
    np.testing.assert_allclose(guess.cam_from_object, poses["7"], atol=1e-9)
    assert policy.first_guess(FrameInfo(9, 0)) is None


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("{", "JSON"),
        ({"poses": 1}, "cam_from_object"),
        ({"cam_from_object": [[1, 2], [3]]}, "4x4"),
        ({"cam_from_object": np.diag([2.0, 1, 1, 1]).tolist()}, "rotation"),
        ({"frames": {"first": np.eye(4).tolist()}}, "frame number"),
        ({"frames": {}}, "cam_from_object"),
    ],
)
def test_a_bad_guess_file_is_named(tmp_path: Path, content: object, complaint: str) -> None:
    spec = write(tmp_path / "guess.json", content)
    with pytest.raises(ConfigError, match=complaint) as caught:
        make_policy(TrackingConfig(guess=spec), VIEWS)
    assert "guess.json" in str(caught.value)


@pytest.mark.parametrize("spec", ["nowhere.json", "perturb:10deg", "perturb:40-10deg,0.2", "perturb:10-400deg,0.2"])
def test_a_bad_guess_says_what_is_expected(spec: str) -> None:
    with pytest.raises(ConfigError, match=r"perturb:|degrees"):
        make_policy(TrackingConfig(guess=spec), VIEWS)


def test_frames_of_a_file_are_no_start(tmp_path: Path) -> None:
    spec = write(tmp_path / "guesses.json", {"frames": {"0": np.eye(4).tolist()}})
    with pytest.raises(ConfigError, match="one pose"):
        start_pose(spec, VIEWS)


def perturbed(seed: int = 0) -> PerturbedTruthPolicy:
    policy = make_policy(TrackingConfig(guess="perturb:10-40deg,0.2", seed=seed), VIEWS)
    assert isinstance(policy, PerturbedTruthPolicy)
    return policy


def test_perturbed_guesses_lie_where_the_paper_says_and_repeat_by_seed_and_frame() -> None:
    assert needs_truth("perturb:10-40deg,0.2")
    assert not needs_truth("train:r_1")
    truth = on_sphere(20, 30)

    def guesses(seed: int, ids: list[int]) -> dict[int, np.ndarray]:
        policy = perturbed(seed)
        for i in ids:
            policy.on_truth(i, truth)
        return {i: policy.first_guess(FrameInfo(i, 0)).cam_from_object for i in ids}  # type: ignore[union-attr]

    forwards, backwards, other = guesses(1, [0, 1, 2]), guesses(1, [2, 1, 0]), guesses(2, [0, 1, 2])
    for i in range(3):
        np.testing.assert_array_equal(forwards[i], backwards[i])
        assert not np.allclose(forwards[i], other[i])
        assert 10 <= rotation_error_deg(forwards[i], truth) <= 40
    assert not np.allclose(forwards[0], forwards[1])


def test_a_frame_without_truth_or_out_of_view_has_no_guess() -> None:
    policy = perturbed()
    assert policy.first_guess(FRAME) is None
    policy.on_truth(FRAME.frame_id, None)
    assert policy.first_guess(FRAME) is None
    policy.on_truth(FRAME.frame_id, np.eye(4))
    assert policy.first_guess(FRAME) is not None


def each_frame(passes: int = 3) -> tuple[EachFramePolicy, Attempt]:
    policy = EachFramePolicy(TrackingConfig(passes=passes), VIEWS, {7: on_sphere(0, 30)})
    guess = policy.first_guess(FRAME)
    assert guess is not None
    return policy, Attempt(FRAME, guess, 0)


def result(pose: np.ndarray | None, pass_index: int = 0) -> PoseResult:
    return PoseResult(7, pass_index, pose is not None, pose, None, 100, 120, 1.0)


def test_single_frames_get_passes_until_the_pose_settles() -> None:
    policy, attempt = each_frame()
    first = result(on_sphere(20, 30))
    guess = policy.next_guess(attempt, first)
    assert guess is not None
    assert guess.reason is GuessReason.NEXT_PASS
    attempt = attempt.again(guess, 0)
    assert policy.next_guess(attempt, result(on_sphere(20.1, 30), 1)) is None
    assert each_frame(passes=1)[0].next_guess(each_frame(1)[1], first) is None


def test_a_single_frame_keeps_an_earlier_pose_when_its_last_pass_fails() -> None:
    policy, attempt = each_frame()
    first = result(on_sphere(20, 30))
    guess = policy.next_guess(attempt, first)
    assert guess is not None
    attempt = attempt.again(guess, 0)
    assert policy.next_guess(attempt, result(None, 1)) is None
    belief = policy.conclude(attempt, result(None, 1))
    assert belief.state is TrackingState.TRACKING
    assert belief.cam_from_object is first.cam_from_object
    policy, attempt = each_frame()
    assert policy.conclude(attempt, result(None)).state is TrackingState.LOST
    assert policy.missed(FRAME).cam_from_object is None


def test_other_views_are_tried_until_a_pose_is_believed() -> None:
    policy, attempt = each_frame()
    tried = []
    while (guess := policy.next_guess(attempt, result(None, attempt.pass_index))) is not None and len(tried) < 5:
        assert guess.reason is GuessReason.RELOCALISATION
        tried.append(guess.cam_from_object)
        attempt = attempt.again(guess, 0)
    distances = [rotation_error_deg(on_sphere(0, 30), pose) for pose in tried]
    assert distances == sorted(distances)
    assert all(any((pose == view).all() for view in VIEWS.cam_from_object) for pose in tried)
    there = result(on_sphere(0, 31), attempt.pass_index)
    assert policy.conclude(attempt, there).state is TrackingState.TRACKING


def test_views_that_look_like_the_frame_are_tried_before_others() -> None:
    alike = [on_sphere(170, 40), on_sphere(0, 30), on_sphere(-90, 20)]
    policy = EachFramePolicy(TrackingConfig(), VIEWS, {7: on_sphere(0, 30)}, lambda frame: alike)
    prior = policy.first_guess(FRAME)
    assert prior is not None
    attempt, tried = Attempt(FRAME, prior, 0), []
    for _ in range(4):
        guess = policy.next_guess(attempt, result(None, attempt.pass_index))
        assert guess is not None
        tried.append(guess.cam_from_object)
        attempt = attempt.again(guess, 0)
    assert tried[0] is alike[0]
    assert tried[1] is alike[2]
    distances = [rotation_error_deg(on_sphere(0, 30), pose) for pose in tried[2:]]
    assert distances == sorted(distances)
    assert distances[0] < rotation_error_deg(on_sphere(0, 30), alike[0])


def test_what_retrieval_has_found_is_kept_by_frame_and_for_a_while() -> None:
    retrieved, second = RetrievedPoses(), 1_000_000_000
    for frame_id in range(80):
        retrieved.add(frame_id, frame_id * second, [on_sphere(frame_id, 0)])
    assert retrieved.of(FrameInfo(79, 79 * second))[0] == pytest.approx(on_sphere(79, 0))
    assert retrieved.of(FrameInfo(3, 3 * second)) == ()
    assert retrieved.of(FrameInfo(79, 78 * second)) == ()
    just_after = FrameInfo(80, 79 * second + 5)
    assert retrieved.of(just_after) == ()
    assert retrieved.near(just_after, within_ns=10.0)[0] == pytest.approx(on_sphere(79, 0))
    assert retrieved.near(just_after, within_ns=4.0) == ()
    retrieved.add(80, 79 * second + 5, [])
    assert retrieved.near(just_after, within_ns=10.0)[0] == pytest.approx(on_sphere(79, 0))
    assert retrieved.near(FrameInfo(50, 50 * second), within_ns=10.0)[0] == pytest.approx(on_sphere(50, 0))


def test_relocalisation_begins_with_what_looks_like_the_frame_and_goes_on_elsewhere() -> None:
    relocaliser = Relocaliser(VIEWS, Limit(40.0, 3.0))
    likely = [on_sphere(5, 5), on_sphere(6, 6), on_sphere(7, 7)]

    def place(pose: np.ndarray) -> int | None:
        return next((i for i, other in enumerate(likely) if (pose == other).all()), None)

    assert place(relocaliser.next()) is None
    tried = [place(relocaliser.next([pose.copy() for pose in likely])) for _ in range(8)]
    assert tried == [0, None, 1, None, 2, None, 0, None]
    assert place(relocaliser.next([likely[2], likely[0]])) == 2


def test_searching_ends_and_leaves_no_pose() -> None:
    config = TrackingConfig(searches=2)
    policy = EachFramePolicy(config, VIEWS, {7: on_sphere(0, 30)})
    prior = policy.first_guess(FRAME)
    assert prior is not None
    attempt = Attempt(FRAME, prior, 0)
    for _ in range(2):
        guess = policy.next_guess(attempt, result(None))
        assert guess is not None
        attempt = attempt.again(guess, 0)
    assert policy.next_guess(attempt, result(None)) is None
    assert policy.conclude(attempt, result(None)).cam_from_object is None


def test_a_sure_pose_outlives_what_comes_after_it() -> None:
    policy, attempt = each_frame(passes=3)
    sure = result(on_sphere(20, 30))
    weak = replace(result(on_sphere(50, 30), 1), inliers=14, correspondences=60)
    for found in (sure, weak):
        guess = policy.next_guess(attempt, found)
        assert guess is not None
        assert guess.reason is GuessReason.NEXT_PASS
        attempt = attempt.again(guess, 0)
    assert policy.next_guess(attempt, result(None, 2)) is None
    assert policy.conclude(attempt, result(None, 2)).cam_from_object is sure.cam_from_object


def test_forgotten_truths_do_not_matter_to_frames_in_flight() -> None:
    policy = perturbed()
    policy.on_truth(FRAME.frame_id, on_sphere(0, 30))
    guess = policy.first_guess(FRAME)
    assert guess is not None
    for other in range(1000, 1400):
        policy.on_truth(other, on_sphere(0, 30))
    assert policy.next_guess(Attempt(FRAME, guess, 0), result(None)) is not None


def weak(inliers: int) -> PoseResult:
    """A pose of which few of 60 lifted points were found."""
    return replace(result(on_sphere(20, 30)), inliers=inliers, correspondences=60)


def second_pass(first: PoseResult) -> tuple[EachFramePolicy, Attempt]:
    """A policy whose first pass has found a weak pose."""
    policy, attempt = each_frame(passes=2)
    guess = policy.next_guess(attempt, first)
    assert guess is not None
    assert guess.reason is GuessReason.NEXT_PASS
    return policy, attempt.again(guess, 0)


def test_a_weak_pose_is_believed_once_a_pass_has_found_it_again() -> None:
    policy, attempt = second_pass(weak(20))
    found_again = replace(weak(20), cam_from_object=on_sphere(20.2, 30), pass_index=1)
    assert policy.next_guess(attempt, found_again) is None
    assert policy.conclude(attempt, found_again).cam_from_object is found_again.cam_from_object


@pytest.mark.parametrize(("inliers", "azimuth"), [(20, 60), (14, 20.2)])
def test_it_is_not_where_a_pass_leads_elsewhere_or_to_a_poor_one(inliers: int, azimuth: float) -> None:
    policy, attempt = second_pass(weak(inliers))
    again = replace(weak(inliers), cam_from_object=on_sphere(azimuth, 30), pass_index=1)
    guess = policy.next_guess(attempt, again)
    assert guess is not None
    assert guess.reason is GuessReason.RELOCALISATION
    assert policy.conclude(attempt, again).cam_from_object is None


def test_a_single_pass_has_nothing_to_confirm_it() -> None:
    policy, attempt = each_frame(passes=1)
    found = weak(14)
    assert policy.next_guess(attempt, result(None)) is None
    assert policy.next_guess(attempt, found) is None
    assert policy.conclude(attempt, found).cam_from_object is found.cam_from_object


def test_nearest_first_lie_apart_from_the_guess_and_each_other() -> None:
    limit, guess = Limit(25.0, 2.0), on_sphere(3, 32)
    order = nearest_first(VIEWS.cam_from_object, guess, limit)
    distances = pairwise(guess[None], VIEWS.cam_from_object, limit)[0]
    assert list(distances[order]) == sorted(distances[order])
    chosen = np.concatenate([guess[None], VIEWS.cam_from_object[order]])
    assert (pairwise(chosen, chosen, limit) + 9 * np.eye(len(chosen))).min() > 1.0
    assert pairwise(VIEWS.cam_from_object, chosen, limit).min(axis=1).max() <= 1.0
    assert nearest_first(np.zeros((0, 4, 4)), guess, limit) == []


def test_farthest_points_cover_all_views_and_are_spread() -> None:
    limit = Limit(40.0, 3.0)
    order = farthest_point_order(VIEWS.cam_from_object, limit)
    chosen = VIEWS.cam_from_object[order]
    assert pairwise(VIEWS.cam_from_object, chosen, limit).min(axis=1).max() <= 1.0
    assert len(order) < len(VIEWS.names) / 2
    among = pairwise(chosen, chosen, limit)
    assert (among + 9 * np.eye(len(order))).min() > 1.0
    assert farthest_point_order(np.zeros((0, 4, 4)), limit) == []


def test_distances_agree_with_the_errors_of_geometry() -> None:
    a, b = on_sphere(0, 20), on_sphere(30, 40, 5.0)
    limit = Limit(10.0, 2.0)
    expected = max(rotation_error_deg(a, b) / 10, translation_error(a, b) / 2)
    assert limit.distance_ratio(a, b) == pytest.approx(expected)
    assert pairwise(a[None], b[None], limit)[0, 0] == pytest.approx(expected)


def test_scale_is_the_spread_of_the_cameras() -> None:
    centred = TrainingViews(tuple("abcd"), np.stack([on_sphere(a, 0) for a in (0, 90, 180, 270)]))
    assert centred.scale == pytest.approx(4.0)
    assert TrainingViews(("a",), np.eye(4)[None]).scale == 1.0


def test_relocalisation_alternates_between_near_poses_and_training_views() -> None:
    near = [on_sphere(1, 1), on_sphere(2, 2)]
    relocaliser = Relocaliser(VIEWS, Limit(40.0, 3.0), near)
    tried = [relocaliser.next() for _ in range(2 * relocaliser.lap)]
    assert all(tried[i] is near[i // 2 % 2] for i in range(0, len(tried), 2))
    views = {pose.tobytes() for pose in tried[1::2]}
    assert len(views) == relocaliser.lap - 2
    relocaliser.push(pushed := on_sphere(3, 3))
    assert relocaliser.next() is pushed
    assert relocaliser.next() is not pushed


def test_keyframes_lie_apart_and_the_oldest_go_first() -> None:
    keyframes = Keyframes(Limit(10.0, 1.0), capacity=3)
    poses = [on_sphere(azimuth, 0) for azimuth in (0, 5, 30, 60, 90)]
    for pose in poses:
        keyframes.add(pose)
    assert len(keyframes) == 3
    assert keyframes.newest(2)[0] is poses[4]
    assert keyframes.nearest(on_sphere(0, 0), otherwise=poses[0]) is poses[2]
    assert Keyframes(Limit(10.0, 1.0), 3).nearest(poses[1], otherwise=poses[0]) is poses[0]
