"""Following one camera: each frame's guess comes from the frames before it."""

from __future__ import annotations

import numpy as np

from fieldpose.bus.messages import GuessReason, TrackingState
from fieldpose.stages.geometry import Limit
from fieldpose.stages.tracking.certainty import Certainty
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.motion import NS_PER_MS, MotionModel
from fieldpose.stages.tracking.policy import Attempt, Belief, FrameInfo, PoseGuess, PoseResult
from fieldpose.stages.tracking.retrieved import RetrievedPoses
from fieldpose.stages.tracking.scoring import score
from fieldpose.stages.tracking.trust import Trust
from fieldpose.stages.tracking.views import Keyframes, Relocaliser, TrainingViews

_NEAR_POSES = 4


class TrackPolicy:
    """Guesses from the camera's motion; a pose is believed when it agrees with them, or is found a second time.

    `start` is the pose to begin with; without one the training views are tried, those that `retrieved` names first.
    ConfigError if there is neither.
    """

    def __init__(
        self,
        config: TrackingConfig,
        views: TrainingViews,
        start: np.ndarray | None = None,
        retrieved: RetrievedPoses | None = None,
    ) -> None:
        scale = self._scale = views.scale
        self._certainty = Certainty(views.error_scale, scale)
        self._config = config
        self._start = start
        self._retrieved = retrieved or RetrievedPoses()
        self._settled = Limit(config.settled_deg, config.settled * scale)
        self._far = Limit(config.far_deg, config.far * scale)
        self._motion = MotionModel(config.motion, scale)
        self._keyframes = Keyframes(Limit(config.keyframe_deg, config.keyframe * scale), config.keyframes)
        near = () if start is None else (start,)
        self._relocaliser = Relocaliser(views, Limit(config.cover_deg, config.cover * scale), near)
        patience = self._relocaliser.lap if start is None else config.lost_after
        self._trust = Trust(config.lost_after, config.weak_after, patience)
        self._guesses = 0
        self._unconfirmed: tuple[int, np.ndarray] | None = None

    def on_truth(self, frame_id: int, cam_from_object: np.ndarray | None) -> None:
        """Tracking never looks at the truth."""

    def first_guess(self, frame: FrameInfo) -> PoseGuess | None:
        """MOTION or KEYFRAME while there is a track, else PRIOR or RELOCALISATION."""
        self._guesses += 1
        if not self._trust.tracked:
            return self._guess_without_track(frame)
        predicted, last = self._motion.predict(frame.capture_ns), self._motion.newest
        if self._trust.state is TrackingState.LIMITED and self._guesses % 2 == 0:
            return self._guess(GuessReason.KEYFRAME, self._keyframes.nearest(predicted, otherwise=last))
        if self._config.sequence == "photos" or not self._motion.within_horizon(frame.capture_ns):
            return self._guess(GuessReason.KEYFRAME, last)
        return self._guess(GuessReason.MOTION, predicted)

    def next_guess(self, attempt: Attempt, result: PoseResult) -> PoseGuess | None:
        """NEXT_PASS from a pose that moved much, another pose to try where none was found, or None."""
        pose = self._usable(result)
        if pose is None:
            return self._retry(attempt)
        trusted = attempt.guess.reason is GuessReason.MOTION
        near_enough = (self._far if trusted else self._settled).holds(attempt.guess.cam_from_object, pose)
        if near_enough or attempt.passes >= self._config.passes:
            return None
        return PoseGuess(GuessReason.NEXT_PASS, pose, attempt.guess.epoch)

    def conclude(self, attempt: Attempt, result: PoseResult) -> Belief:
        """Believe the pose or not, and move on to the next state."""
        pose, capture_ns = self._usable(result), attempt.frame.capture_ns
        if pose is not None and self._plausible(attempt, pose, result):
            return self._accept(attempt, result, pose, begins=not self._trust.tracked)
        if pose is not None and self._confirms(capture_ns, pose):
            return self._accept(attempt, result, pose, begins=True)
        if attempt.guess.epoch == self._trust.epoch:
            self._reject(capture_ns, pose)
        return self._without_pose(attempt.frame)

    def missed(self, frame: FrameInfo) -> Belief:
        """A lost message speaks against no pose, but what nobody has seen for long is no longer trusted."""
        if not self._motion.within_horizon(frame.capture_ns):
            self._trust.stale()
        return self._without_pose(frame)

    def _guess(self, reason: GuessReason, cam_from_object: np.ndarray) -> PoseGuess:
        return PoseGuess(reason, cam_from_object, self._trust.epoch)

    def _guess_without_track(self, frame: FrameInfo) -> PoseGuess:
        if self._start is not None and self._trust.state is TrackingState.INITIALIZING:
            return self._guess(GuessReason.PRIOR, self._start)
        return self._guess(GuessReason.RELOCALISATION, self._search(frame))

    def _search(self, frame: FrameInfo) -> np.ndarray:
        """A pose to try for a frame of which nothing is known."""
        photos = self._config.sequence == "photos"
        within_ns = 0.0 if photos else self._config.motion.horizon_ms * NS_PER_MS
        return self._relocaliser.next(self._retrieved.near(frame, within_ns))

    def _retry(self, attempt: Attempt) -> PoseGuess | None:
        photos = self._config.sequence == "photos"
        if attempt.retries >= (self._config.searches if photos else self._config.retries):
            return None
        guess = attempt.guess
        if attempt.retries == 0 and self._trust.tracked and not photos:
            nearest = self._keyframes.nearest(guess.cam_from_object, otherwise=self._motion.newest)
            return PoseGuess(GuessReason.KEYFRAME, nearest, guess.epoch)
        return PoseGuess(GuessReason.RELOCALISATION, self._search(attempt.frame), guess.epoch)

    def _quality(self, result: PoseResult) -> float:
        return score(result, self._config.score, self._scale)

    def _usable(self, result: PoseResult) -> np.ndarray | None:
        return result.cam_from_object if self._quality(result) >= self._config.score.usable else None

    def _plausible(self, attempt: Attempt, pose: np.ndarray, result: PoseResult) -> bool:
        """On the camera's way; where no way is known, near the guess that it was found from, and good."""
        if self._trust.tracked and self._config.sequence == "video":
            return self._on_the_way(attempt.frame.capture_ns, pose)
        good = self._trust.tracked or self._quality(result) >= self._config.score.good
        return good and self._far.holds(attempt.guess.cam_from_object, pose)

    def _on_the_way(self, capture_ns: int, pose: np.ndarray) -> bool:
        reach = self._reach(capture_ns - self._motion.newest_ns)
        return reach.holds(self._motion.predict(capture_ns), pose)

    def _confirms(self, capture_ns: int, pose: np.ndarray) -> bool:
        """Whether another frame of the video has led to the same pose."""
        if self._unconfirmed is None or self._config.sequence == "photos":
            return False
        before_ns, before = self._unconfirmed
        return self._reach(capture_ns - before_ns).holds(before, pose)

    def _reach(self, between_ns: int) -> Limit:
        """How far a camera may be, after that time, from where it was expected."""
        config, seconds = self._config, abs(between_ns) * 1e-9
        distance = (config.jump + config.jump_per_s * seconds) * self._scale
        return Limit(config.jump_deg + config.jump_deg_per_s * seconds, distance)

    def _accept(self, attempt: Attempt, result: PoseResult, pose: np.ndarray, begins: bool) -> Belief:
        quality, was_tracked = self._quality(result), self._trust.tracked
        if begins:
            self._motion.reset()
        self._motion.add(attempt.frame.capture_ns, pose)
        self._unconfirmed = None
        if quality >= self._config.score.good:
            self._trust.good()
            self._keyframes.add(pose)
        else:
            self._trust.weak()
            self._prepare_relocalisation(was_tracked)
        covariance = self._certainty.of(result.covariance, attempt.guess.cam_from_object, pose)
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

    def _without_pose(self, frame: FrameInfo) -> Belief:
        """In a video the motion carries on for a while; the score of 0 tells that nothing was measured."""
        known = self._trust.tracked and self._config.sequence == "video"
        carried_on = known and self._motion.within_horizon(frame.capture_ns)
        return Belief(self._trust.state, 0.0, self._motion.predict(frame.capture_ns) if carried_on else None)
