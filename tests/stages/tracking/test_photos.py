"""The policy for photos step by step: each stands by itself, and is searched for until a pose is believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.tracking_world import frame_info, on_sphere, ring_of_views

from fieldpose.bus.messages import GuessReason, Reason, TrackingState
from fieldpose.stages.tracking.config import COVER as COVER_BY_SCALE
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.photos import PhotoPolicy
from fieldpose.stages.tracking.policy import Alike, Attempt, Belief, Look, PoseGuess, PoseResult, Step
from fieldpose.stages.tracking.priors import Priors
from fieldpose.stages.tracking.search import farthest_point_order

VIEWS = ring_of_views()
FRAME = frame_info(7)
PRIOR = on_sphere(0, 30)
COVER = COVER_BY_SCALE.scaled(VIEWS.scale)
NOWHERE = Alike(reason=Reason.NOT_AVAILABLE)


class Photo:
    """One photo on its way, with every step taken as the Tracker takes it; `step` is the newest."""

    def __init__(self, policy: PhotoPolicy, frame_id: int = FRAME.frame_id) -> None:
        self.policy = policy
        self.attempt = Attempt(frame_info(frame_id), 0)
        self.result = PoseResult(frame_id, 0)
        self.tried: list[np.ndarray] = []
        self._go_on(policy.first_step(self.attempt.frame))

    @property
    def reason(self) -> GuessReason | None:
        """That of the newest step; None where that is no guess."""
        return self.step.reason if isinstance(self.step, PoseGuess) else None

    def looks(self, alike: Alike) -> None:
        """Answer its Look."""
        assert self.step == Look()
        self._go_on(self.policy.after_look(self.attempt, alike))

    def gives(self, pose: np.ndarray | None, inliers: int = 100, correspondences: int = 120) -> None:
        """Answer its guess."""
        assert isinstance(self.step, PoseGuess)
        reason = Reason.NO_CONSENSUS if pose is None else None
        ids = self.attempt.frame.frame_id, self.attempt.pass_index
        self.result = PoseResult(*ids, pose, None, inliers, correspondences, 1.0, reason)
        self._go_on(self.policy.next_step(self.attempt, self.result))

    def fails(self, times: int = 1) -> None:
        for _ in range(times):
            self.gives(None)

    def belief(self) -> Belief:
        return self.policy.conclude(self.attempt, self.result)

    def _go_on(self, step: Step | None) -> None:
        self.step = step
        if isinstance(step, PoseGuess):
            self.attempt = self.attempt.again(step, 0)
            self.tried.append(step.cam_from_object)


def photos(
    prior: np.ndarray | None = PRIOR, looks: bool = False, start: np.ndarray | None = None, **config: int
) -> PhotoPolicy:
    given = {} if prior is None else {FRAME.frame_id: prior}
    settings = TrackingConfig(**config)  # type: ignore[arg-type]
    return PhotoPolicy(settings, VIEWS, Priors(given=given), start, looks)


def is_view(pose: np.ndarray) -> bool:
    return any((pose == view).all() for view in VIEWS.cam_from_object)


def apart(pose: np.ndarray) -> float:
    """How far a pose is from the prior."""
    return COVER.distance_ratio(PRIOR, pose)


def test_a_photo_begins_with_its_prior_then_with_the_start_then_with_a_look() -> None:
    both = Photo(photos(PRIOR, looks=True, start=on_sphere(50, 20)))
    assert (both.reason, both.tried[0] is PRIOR) == (GuessReason.PRIOR, True)
    start = Photo(photos(None, looks=True, start=PRIOR))
    assert (start.reason, start.tried[0] is PRIOR) == (GuessReason.PRIOR, True)
    assert Photo(photos(None, looks=True)).step == Look()


def test_without_retrieval_or_guess_training_views_are_tried_so_that_few_cover_all() -> None:
    photo = Photo(photos(None, looks=False, searches=100))
    expected = [VIEWS.cam_from_object[i] for i in farthest_point_order(VIEWS.cam_from_object, COVER)]
    assert photo.reason is GuessReason.RELOCALISATION
    photo.fails(len(expected) - 1)
    np.testing.assert_array_equal(photo.tried, expected)
    assert photo.reason is GuessReason.RELOCALISATION
    photo.fails()
    assert photo.step is None


def test_the_view_that_looks_most_like_a_photo_comes_first_then_the_others_then_few_that_cover_all() -> None:
    alike = [on_sphere(170, 40), on_sphere(-90, 20)]
    photo = Photo(photos(None, looks=True))
    photo.looks(Alike(alike))
    assert photo.reason is GuessReason.RELOCALISATION
    photo.fails(3)
    assert photo.tried[0] is alike[0]
    assert photo.tried[1] is alike[1]
    assert all(is_view(pose) for pose in photo.tried[2:])
    assert not any(COVER.holds(pose, other) for pose in photo.tried[2:] for other in alike)


def test_a_photo_that_nothing_looks_like_is_given_up_at_once() -> None:
    photo = Photo(photos(None, looks=True))
    photo.looks(Alike(reason=Reason.NOTHING_ALIKE))
    assert photo.step is None
    photo.result = PoseResult(7, 0, reason=Reason.NOTHING_ALIKE)
    belief = photo.belief()
    assert (belief.state, belief.score, belief.reason) == (TrackingState.LOST, 0.0, Reason.NOTHING_ALIKE)


@pytest.mark.parametrize("reason", [Reason.NOT_AVAILABLE, Reason.NO_ANSWER, Reason.INTERNAL_ERROR])
def test_a_retrieval_that_does_not_work_keeps_no_photo_from_being_searched_for(reason: Reason) -> None:
    photo = Photo(photos(None, looks=True))
    photo.looks(Alike(reason=reason))
    assert photo.reason is GuessReason.RELOCALISATION
    assert is_view(photo.tried[0])


def test_a_guess_that_leads_nowhere_is_followed_by_one_look_and_what_looks_like_the_photo() -> None:
    alike = [on_sphere(170, 40), PRIOR.copy(), on_sphere(-90, 20)]
    photo = Photo(photos(looks=True))
    photo.fails()
    photo.looks(Alike(alike))
    photo.fails(3)
    tried = photo.tried[1:]
    assert tried[0] is alike[0]
    assert tried[1] is alike[2]
    distances = [apart(pose) for pose in tried[2:]]
    assert distances == sorted(distances)
    assert distances[0] < apart(alike[0])


def test_a_photo_with_a_guess_is_searched_for_even_if_nothing_looks_like_it() -> None:
    photo = Photo(photos(looks=True))
    photo.fails()
    photo.looks(Alike(reason=Reason.NOTHING_ALIKE))
    assert photo.reason is GuessReason.RELOCALISATION
    assert is_view(photo.tried[1])


def test_other_views_are_tried_the_nearest_first_until_a_pose_is_believed() -> None:
    photo = Photo(photos())
    photo.fails(6)
    assert photo.reason is GuessReason.RELOCALISATION
    distances = [apart(pose) for pose in photo.tried[1:]]
    assert distances == sorted(distances)
    assert all(is_view(pose) for pose in photo.tried[1:])
    photo.gives(photo.tried[-1])
    assert photo.step is None
    belief = photo.belief()
    assert (belief.state, belief.reason) == (TrackingState.TRACKING, None)
    assert belief.cam_from_object is photo.tried[-1]


def test_passes_go_on_until_the_pose_settles() -> None:
    photo = Photo(photos())
    photo.gives(first := on_sphere(20, 30))
    assert (photo.reason, photo.tried[-1] is first) == (GuessReason.NEXT_PASS, True)
    photo.gives(on_sphere(20.1, 30))
    assert photo.step is None
    single = Photo(photos(passes=1))
    single.gives(first)
    assert single.step is None


def test_no_more_passes_from_a_guess_than_configured() -> None:
    photo = Photo(photos(passes=3))
    for azimuth in (20, 40, 60):
        assert photo.reason is not GuessReason.RELOCALISATION
        photo.gives(on_sphere(azimuth, 30), inliers=14, correspondences=60)
    assert photo.reason is GuessReason.RELOCALISATION
    assert photo.attempt.passes == 1


def test_a_photo_keeps_an_earlier_pose_when_its_last_pass_fails() -> None:
    photo = Photo(photos())
    photo.gives(first := on_sphere(20, 30))
    photo.fails()
    assert photo.step is None
    belief = photo.belief()
    assert belief.state is TrackingState.TRACKING
    assert belief.cam_from_object is first


def test_a_photo_that_is_not_found_is_lost_for_the_reason_of_its_first_pass() -> None:
    photo = Photo(photos(searches=1))
    photo.gives(None)
    photo.gives(on_sphere(20, 30), inliers=5)
    assert photo.step is None
    belief = photo.belief()
    assert (belief.state, belief.cam_from_object) == (TrackingState.LOST, None)
    assert belief.reason is Reason.NO_CONSENSUS


def test_a_photo_that_did_not_come_back_is_lost_and_forgotten() -> None:
    policy = photos()
    Photo(policy)
    belief = policy.missed(FRAME, Reason.NO_ANSWER)
    assert (belief.state, belief.cam_from_object) == (TrackingState.LOST, None)
    assert belief.reason is Reason.NO_ANSWER
    assert policy.missed(FRAME, Reason.NO_GUESS).reason is Reason.NO_GUESS
    assert len(Photo(policy).tried) == 1


@pytest.mark.parametrize("looks", [False, True])
def test_no_photo_learns_from_another(looks: bool) -> None:
    def way(policy: PhotoPolicy) -> list[np.ndarray]:
        photo = Photo(policy, 20)
        if looks:
            photo.looks(NOWHERE)
        photo.fails(3)
        return photo.tried

    used = photos(looks=looks)
    for frame_id in (7, 8, 9):
        earlier = Photo(used, frame_id)
        if earlier.step == Look():
            earlier.looks(Alike([on_sphere(100, 20)]))
        earlier.gives(earlier.tried[-1])
        assert earlier.belief().state is TrackingState.TRACKING
    np.testing.assert_array_equal(way(used), way(photos(looks=looks)))


def test_photos_that_are_in_flight_at_once_do_not_mix() -> None:
    policy = photos(looks=True)
    first = Photo(policy)
    second = Photo(policy, 8)
    second.looks(Alike([alike := on_sphere(100, 20)]))
    first.fails()
    second.gives(alike)
    assert second.belief().cam_from_object is alike
    assert first.step == Look()
    first.looks(NOWHERE)
    first.gives(found := first.tried[-1])
    assert first.belief().cam_from_object is found


def test_a_photo_whose_prior_is_awaited_has_no_step_without_it() -> None:
    policy = PhotoPolicy(TrackingConfig(), VIEWS, Priors(awaited=True), looks=True)
    assert policy.first_step(FRAME) is None
    policy.on_prior(8, PRIOR)
    assert policy.first_step(FRAME) is None
    policy.on_prior(7, PRIOR)
    photo = Photo(policy)
    assert (photo.reason, photo.tried[0] is PRIOR) == (GuessReason.PRIOR, True)


def test_forgotten_priors_do_not_matter_to_photos_in_flight() -> None:
    policy = PhotoPolicy(TrackingConfig(), VIEWS, Priors(awaited=True), looks=False)
    policy.on_prior(7, PRIOR)
    photo = Photo(policy)
    for other in range(1000, 1400):
        policy.on_prior(other, PRIOR)
    assert policy.first_step(frame_info(8)) is None
    photo.fails()
    assert photo.reason is GuessReason.RELOCALISATION


@pytest.mark.parametrize("looks", [False, True])
@pytest.mark.parametrize(("prior", "tried"), [(PRIOR, 3), (None, 3)], ids=["guess", "no guess"])
def test_searching_ends_and_leaves_no_pose(prior: np.ndarray | None, tried: int, looks: bool) -> None:
    photo = Photo(photos(prior, looks, searches=2))
    while photo.step is not None:
        if photo.step == Look():
            photo.looks(NOWHERE)
        else:
            photo.fails()
    assert len(photo.tried) == tried
    assert photo.belief().cam_from_object is None


def test_no_searches_means_no_look_after_a_guess() -> None:
    photo = Photo(photos(looks=True, searches=0))
    photo.fails()
    assert photo.step is None


def test_a_sure_pose_outlives_what_comes_after_it() -> None:
    photo = Photo(photos(passes=3))
    photo.gives(sure := on_sphere(20, 30))
    photo.gives(on_sphere(50, 30), inliers=14, correspondences=60)
    assert photo.reason is GuessReason.NEXT_PASS
    photo.fails()
    assert photo.step is None
    assert photo.belief().cam_from_object is sure


def second_pass(inliers: int) -> Photo:
    """A photo whose first pass has found a weak pose: of 60 lifted points, few were found."""
    photo = Photo(photos(passes=2))
    photo.gives(on_sphere(20, 30), inliers, correspondences=60)
    assert photo.reason is GuessReason.NEXT_PASS
    return photo


def test_a_weak_pose_is_believed_once_a_pass_has_found_it_again() -> None:
    photo = second_pass(20)
    photo.gives(again := on_sphere(20.2, 30), 20, correspondences=60)
    assert photo.step is None
    assert photo.belief().cam_from_object is again


@pytest.mark.parametrize(("inliers", "azimuth"), [(20, 60), (14, 20.2)])
def test_it_is_not_where_a_pass_leads_elsewhere_or_to_a_poor_one(inliers: int, azimuth: float) -> None:
    photo = second_pass(inliers)
    before = photo.attempt
    photo.gives(on_sphere(azimuth, 30), inliers, correspondences=60)
    assert photo.reason is GuessReason.RELOCALISATION
    belief = photo.policy.conclude(before, photo.result)
    assert (belief.cam_from_object, belief.reason) == (None, Reason.IMPLAUSIBLE_POSE)


@pytest.mark.parametrize("looks", [False, True])
def test_a_single_pass_has_nothing_to_confirm_it_and_is_not_searched_for(looks: bool) -> None:
    policy = photos(looks=looks, passes=1)
    lost = Photo(policy)
    lost.fails()
    assert lost.step is None
    assert lost.belief().state is TrackingState.LOST
    weak = Photo(policy)
    weak.gives(pose := on_sphere(20, 30), inliers=14, correspondences=60)
    assert weak.step is None
    assert weak.belief().cam_from_object is pose
    unusable = Photo(policy)
    unusable.gives(pose, inliers=5)
    assert replace(unusable.belief(), reason=None) == Belief(TrackingState.LOST, 0.0)


@pytest.mark.parametrize("reason", [Reason.FRAME_UNREADABLE, Reason.FRAME_MISSING])
def test_no_other_guess_is_tried_for_a_photo_that_cannot_be_seen(reason: Reason) -> None:
    policy = photos(looks=True)
    step = policy.first_step(FRAME)
    assert isinstance(step, PoseGuess)
    attempt = Attempt(FRAME, 0).again(step, 0)
    result = PoseResult(FRAME.frame_id, 0, reason=reason)
    assert policy.next_step(attempt, result) is None
    assert policy.conclude(attempt, result).reason is reason


def test_what_was_believed_stays_where_the_pass_that_was_to_confirm_it_is_lost() -> None:
    photo = Photo(policy := photos())
    photo.gives(pose := on_sphere(20, 30))
    belief = policy.missed(FRAME, Reason.NO_ANSWER)
    assert belief.state is TrackingState.TRACKING
    assert belief.cam_from_object is pose
