"""Videos: following one camera, each frame's guess comes from the frames before it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from cachetools import FIFOCache

from fieldpose.bus.messages import GuessReason, Reason, TrackingState
from fieldpose.stages.geometry import Limit
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.certainty import Certainty
from fieldpose.stages.tracking.config import COVER, KEYFRAME, KEYFRAMES, TrackingConfig
from fieldpose.stages.tracking.motion import MotionModel
from fieldpose.stages.tracking.policy import Alike, Attempt, Belief, FrameInfo, Look, PoseGuess, PoseResult, Step
from fieldpose.stages.tracking.priors import Priors
from fieldpose.stages.tracking.scoring import score
from fieldpose.stages.tracking.search import Keyframes, Relocaliser
from fieldpose.stages.tracking.trust import Trust

_NEAR_POSES = 4
_KEPT_ALIKE = 16
"""The newest frames for which it is known which views look like them."""


class VideoPolicy:
    """Guesses from the camera's motion; a pose is believed when it agrees with them, or is found a second time.

    A prior that has come for a frame is its guess. `start` is the pose to begin with; without one the training views
    are tried, those that look like the frame first where `looks` says that retrieval can be asked. ConfigError if
    there is nothing to begin with.
    """

    def __init__(
        self, config: TrackingConfig, views: TrainingViews, priors: Priors, start: np.ndarray | None = None,
        looks: bool = True,
    ) -> None:  # fmt: skip
        scale = self._scale = views.scale
        self._certainty = Certainty(views.error_scale, scale)
        self._config, self._priors, self._looks, self._home = config, priors, looks, start
        self._settled = config.settled.scaled(scale)
        self._far = config.far.scaled(scale)
        self._relocaliser = Relocaliser(views, COVER.scaled(scale), _near(start))
        self._begin(start)

    @property
    def begins_at(self) -> np.ndarray | None:
        """Where it begins when nothing is known of the camera; None where training views are tried."""
        return self._start

    def restart(self, start: np.ndarray | None = None) -> None:
        """Forget all that frames have told, and begin at `start`, or without one as this policy first did.

        Priors that have come are for frames to come, and stay.
        """
        self._begin(self._home if start is None else start)

    def _begin(self, start: np.ndarray | None) -> None:
        config, scale = self._config, self._scale
        self._start = start
        self._motion = MotionModel(config.motion, scale)
        self._keyframes = Keyframes(KEYFRAME.scaled(scale), KEYFRAMES)
        self._relocaliser.begin(_near(start))
        patience = self._relocaliser.lap if start is None else config.lost_after
        self._trust = Trust(config.lost_after, config.weak_after, patience)
        self._guesses = 0
        self._alike: FIFOCache[int, Sequence[np.ndarray]] = FIFOCache(_KEPT_ALIKE)
        self._unconfirmed: tuple[int, np.ndarray] | None = None

    def on_prior(self, frame_id: int, cam_from_object: np.ndarray) -> None:
        """Keep it for its frame."""
        self._priors.add(frame_id, cam_from_object)

    def first_step(self, frame: FrameInfo) -> Step | None:
        """PRIOR where one has come; MOTION or KEYFRAME while there is a track, else where to begin, or a Look."""
        self._guesses += 1
        prior = self._priors.take(frame.frame_id)
        if prior is not None:
            return self._guess(GuessReason.PRIOR, prior)
        if not self._trust.tracked:
            return self._step_without_track()
        predicted, last = self._motion.predict(frame.capture_ns), self._motion.newest
        if self._trust.state is TrackingState.LIMITED and self._guesses % 2 == 0:
            return self._guess(GuessReason.KEYFRAME, self._keyframes.nearest(predicted, otherwise=last))
        if not self._motion.within_horizon(frame.capture_ns):
            return self._guess(GuessReason.KEYFRAME, last)
        return self._guess(GuessReason.MOTION, predicted)

    def after_look(self, attempt: Attempt, alike: Alike) -> PoseGuess | None:
        """RELOCALISATION: a training view that looks like the frame, or another pose to try."""
        self._alike[attempt.frame.frame_id] = alike.poses
        return self._guess(GuessReason.RELOCALISATION, self._relocaliser.next(alike.poses))

    def next_step(self, attempt: Attempt, result: PoseResult) -> Step | None:
        """NEXT_PASS from a pose that moved much, another pose to try where none was found, or None."""
        pose, guess = self._usable(result), attempt.guess
        if guess is None:
            return None
        if pose is None:
            return self._retry(attempt, guess)
        trusted = guess.reason is GuessReason.MOTION
        near_enough = (self._far if trusted else self._settled).holds(guess.cam_from_object, pose)
        if near_enough or attempt.passes >= self._config.passes:
            return None
        return PoseGuess(GuessReason.NEXT_PASS, pose, guess.epoch)

    def conclude(self, attempt: Attempt, result: PoseResult) -> Belief:
        """Believe the pose or not, and move on to the next state."""
        pose, capture_ns, guess = self._usable(result), attempt.frame.capture_ns, attempt.guess
        if pose is not None and guess is not None and self._plausible(guess, capture_ns, pose, result):
            return self._accept(guess, capture_ns, pose, result, begins=not self._trust.tracked)
        if pose is not None and guess is not None and self._confirms(capture_ns, pose):
            return self._accept(guess, capture_ns, pose, result, begins=True)
        if attempt.epoch == self._trust.epoch:
            self._reject(capture_ns, pose)
        return self._without_pose(attempt.frame, result.reason or Reason.IMPLAUSIBLE_POSE)

    def missed(self, frame: FrameInfo, reason: Reason) -> Belief:
        """A lost message speaks against no pose, but what nobody has seen for long is no longer trusted."""
        if not self._motion.within_horizon(frame.capture_ns):
            self._trust.stale()
        return self._without_pose(frame, reason)

    def _guess(self, reason: GuessReason, cam_from_object: np.ndarray) -> PoseGuess:
        return PoseGuess(reason, cam_from_object, self._trust.epoch)

    def _step_without_track(self) -> Step:
        if self._start is not None and self._trust.state is TrackingState.INITIALIZING:
            return self._guess(GuessReason.PRIOR, self._start)
        if self._looks and not self._relocaliser.has_found:
            return Look()
        return self._guess(GuessReason.RELOCALISATION, self._relocaliser.next())

    def _retry(self, attempt: Attempt, guess: PoseGuess) -> PoseGuess | None:
        if attempt.retries >= self._config.retries:
            return None
        if attempt.retries == 0 and self._trust.tracked:
            nearest = self._keyframes.nearest(guess.cam_from_object, otherwise=self._motion.newest)
            return PoseGuess(GuessReason.KEYFRAME, nearest, guess.epoch)
        other = self._relocaliser.next(self._alike.get(attempt.frame.frame_id, ()))
        return PoseGuess(GuessReason.RELOCALISATION, other, guess.epoch)

    def _quality(self, result: PoseResult) -> float:
        return score(result, self._config.score, self._scale)

    def _usable(self, result: PoseResult) -> np.ndarray | None:
        return result.cam_from_object if self._quality(result) >= self._config.score.usable else None

    def _plausible(self, guess: PoseGuess, capture_ns: int, pose: np.ndarray, result: PoseResult) -> bool:
        """On the camera's way; where no way is known, near the guess that it was found from, and good."""
        if self._trust.tracked:
            reach = self._reach(capture_ns - self._motion.newest_ns)
            return reach.holds(self._motion.predict(capture_ns), pose)
        return self._quality(result) >= self._config.score.good and self._far.holds(guess.cam_from_object, pose)

    def _confirms(self, capture_ns: int, pose: np.ndarray) -> bool:
        """Whether another frame has led to the same pose."""
        if self._unconfirmed is None:
            return False
        before_ns, before = self._unconfirmed
        return self._reach(capture_ns - before_ns).holds(before, pose)

    def _reach(self, between_ns: int) -> Limit:
        """How far a camera may be, after that time, from where it was expected."""
        config, seconds = self._config, abs(between_ns) * 1e-9
        angle_deg = config.jump.angle_deg + config.jump_per_s.angle_deg * seconds
        return Limit(angle_deg, config.jump.distance + config.jump_per_s.distance * seconds).scaled(self._scale)

    def _accept(self, guess: PoseGuess, capture_ns: int, pose: np.ndarray, result: PoseResult, begins: bool) -> Belief:
        quality, was_tracked = self._quality(result), self._trust.tracked
        if begins:
            self._motion.reset()
        self._motion.add(capture_ns, pose)
        self._unconfirmed = None
        if quality >= self._config.score.good:
            self._trust.good()
            self._keyframes.add(pose)
        else:
            self._trust.weak()
            self._prepare_relocalisation(was_tracked)
        covariance = self._certainty.of(result.covariance, guess.cam_from_object, pose)
        return Belief(self._trust.state, quality, pose, covariance)

    def _reject(self, capture_ns: int, pose: np.ndarray | None) -> None:
        was_tracked = self._trust.tracked
        self._trust.rejected()
        self._prepare_relocalisation(was_tracked)
        if pose is not None:
            self._unconfirmed = (capture_ns, pose)
            self._relocaliser.push(pose)

    def _prepare_relocalisation(self, was_tracked: bool) -> None:
        if was_tracked and not self._trust.tracked:
            self._relocaliser.restart([self._motion.newest, *self._keyframes.newest(_NEAR_POSES)])

    def _without_pose(self, frame: FrameInfo, reason: Reason) -> Belief:
        """The motion carries on for a while; the score of 0 tells that nothing was measured."""
        carried_on = self._trust.tracked and self._motion.within_horizon(frame.capture_ns)
        pose = self._motion.predict(frame.capture_ns) if carried_on else None
        return Belief(self._trust.state, 0.0, pose, reason=reason)


def _near(start: np.ndarray | None) -> Sequence[np.ndarray]:
    return () if start is None else (start,)
