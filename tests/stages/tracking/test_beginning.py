"""What --guess may say, and the policies it makes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.tracking_world import frame_info, on_sphere, ring_of_views

from fieldpose.bus.messages import GuessReason
from fieldpose.errors import ConfigError, DatasetError
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.beginning import Beginning, Disturbance, beginning, make_policy
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.photos import PhotoPolicy
from fieldpose.stages.tracking.policy import Look, Policy, PoseGuess
from fieldpose.stages.tracking.video import VideoPolicy

VIEWS = ring_of_views()
FRAME = frame_info(7)


def write(path: Path, content: object) -> str:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return str(path)


def first_guess(policy: Policy) -> PoseGuess:
    step = policy.first_step(FRAME)
    assert isinstance(step, PoseGuess)
    return step


def test_a_training_view_is_found_by_its_name_or_the_end_of_it() -> None:
    np.testing.assert_array_equal(beginning("train:r_3", VIEWS).start, VIEWS.cam_from_object[3])
    guess = first_guess(make_policy(TrackingConfig(guess="train:train/r_5.png"), VIEWS))
    assert guess.reason is GuessReason.PRIOR
    np.testing.assert_array_equal(guess.cam_from_object, VIEWS.cam_from_object[5])


def test_a_training_view_that_does_not_exist_is_an_error() -> None:
    with pytest.raises(DatasetError, match="r_99"):
        beginning("train:r_99", VIEWS)
    with pytest.raises(ConfigError, match="does not tell"):
        beginning("train:r_1", TrainingViews((), np.zeros((0, 4, 4))))


def test_what_a_training_view_means_is_left_open_where_none_are_known() -> None:
    assert beginning("train:r_99", None) == Beginning()


def test_a_file_with_one_pose_starts_the_track(tmp_path: Path) -> None:
    pose = on_sphere(40, 20)
    spec = write(tmp_path / "guess.json", {"cam_from_object": pose.tolist()})
    policy = make_policy(TrackingConfig(guess=spec), VIEWS)
    assert isinstance(policy, VideoPolicy)
    guess = first_guess(policy)
    assert guess.reason is GuessReason.PRIOR
    np.testing.assert_allclose(guess.cam_from_object, pose, atol=1e-9)
    assert not beginning(spec, VIEWS).by_frame


def test_a_file_with_a_pose_for_each_frame_gives_each_its_own(tmp_path: Path) -> None:
    poses = {str(i): on_sphere(10 * i, 20).tolist() for i in (7, 8)}
    spec = write(tmp_path / "guesses.json", {"frames": poses})
    policy = make_policy(TrackingConfig(guess=spec), VIEWS)
    assert isinstance(policy, PhotoPolicy)
    np.testing.assert_allclose(first_guess(policy).cam_from_object, poses["7"], atol=1e-9)
    assert policy.first_step(frame_info(9)) is None
    begins = beginning(spec, VIEWS)
    assert (begins.by_frame, begins.start, sorted(begins.frames)) == (True, None, [7, 8])


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


def test_a_guess_that_is_nearly_rigid_is_made_so(tmp_path: Path) -> None:
    rounded = np.round(on_sphere(40, 20), 4)
    start = beginning(write(tmp_path / "guess.json", {"cam_from_object": rounded.tolist()}), VIEWS).start
    assert start is not None
    np.testing.assert_allclose(start, rounded, atol=1e-3)
    np.testing.assert_allclose(start[:3, :3] @ start[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("spec", ["nowhere.json", "perturb:10deg", "perturb:40-10deg,0.2", "perturb:10-400deg,0.2"])
@pytest.mark.parametrize("views", [VIEWS, None], ids=["views", "no views"])
def test_a_bad_guess_says_what_is_expected(spec: str, views: TrainingViews | None) -> None:
    with pytest.raises(ConfigError, match=r"perturb:|degrees"):
        beginning(spec, views)


def test_a_disturbance_is_read_and_makes_frames_wait_for_their_priors() -> None:
    begins = beginning("perturb:5-12.5deg,0.3", VIEWS)
    assert begins == Beginning(disturbance=Disturbance((5.0, 12.5), 0.3))
    assert begins.by_frame
    policy = make_policy(TrackingConfig(guess="perturb:5-12.5deg,0.3"), VIEWS, looks=True)
    assert isinstance(policy, PhotoPolicy)
    assert policy.first_step(FRAME) is None
    policy.on_prior(7, pose := on_sphere(3, 20))
    assert first_guess(policy).cam_from_object is pose


@pytest.mark.parametrize(("sequence", "kind"), [("photos", PhotoPolicy), ("video", VideoPolicy), ("auto", VideoPolicy)])
def test_without_a_guess_the_sequence_chooses_the_policy_and_a_look_comes_first(sequence: str, kind: type) -> None:
    config = TrackingConfig(sequence=sequence)  # type: ignore[arg-type]
    asking = make_policy(config, VIEWS, looks=True)
    assert isinstance(asking, kind)
    assert asking.first_step(FRAME) == Look()
    assert first_guess(make_policy(config, VIEWS)).reason is GuessReason.RELOCALISATION


def test_every_photo_begins_at_the_start_but_a_video_only_until_it_is_tracked() -> None:
    photos = make_policy(TrackingConfig(guess="train:r_2", sequence="photos"), VIEWS, looks=True)
    for frame_id in range(3):
        step = photos.first_step(frame_info(frame_id))
        assert isinstance(step, PoseGuess)
        np.testing.assert_array_equal(step.cam_from_object, VIEWS.cam_from_object[2])
