"""Videos whose every frame is followed, while solving goes on beside it on some of them.

Following gives each frame its pose at once. Solves (render, match, lift, PnP) are asked for where no view has seen what
the camera will see soon, where little is found, and now and then for certainty; what one finds late is carried on to
the newest frame, and so never pulls the pose back.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from cachetools import FIFOCache

from fieldpose.bus.messages import GuessReason, Reason
from fieldpose.errors import RefusedError
from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.following.config import POINTS_BY_LEVEL, FollowingConfig
from fieldpose.stages.following.core import Followed, Follower
from fieldpose.stages.following.turning import turned
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.certainty import FocalCheck
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.motion import NS_PER_MS
from fieldpose.stages.tracking.policy import Attempt, Belief, FrameInfo, PoseResult, Step
from fieldpose.stages.tracking.priors import Priors
from fieldpose.stages.tracking.smoothing import PoseFilter
from fieldpose.stages.tracking.video import VideoPolicy

_KEPT_FRAMES = 64
_HOPS = 6
"""So many frames, at most, are followed to carry a late pose on to the newest."""


@dataclass(frozen=True)
class Seen:
    """A frame and its grey values."""

    frame: FrameInfo
    image: FramePyramid


@dataclass(frozen=True)
class Measured:
    """What following has made of a frame, and how good that is."""

    followed: Followed
    quality: float


@dataclass(frozen=True)
class Keyframe:
    """A frame that is solved so that its view is kept, and that view once it is there."""

    frame: FrameInfo
    view_id: str | None = None


class FollowedPolicy(VideoPolicy):
    """A VideoPolicy for the frames that are solved, and the pose of every frame besides.

    ahead_ms: how long it takes until a view that is asked for is there; level: how much less than it might following
    does; solve_ms: a frame is solved at least this often, whatever is followed. Views stay when it is restarted.
    """

    def __init__(
        self, config: TrackingConfig, following: FollowingConfig, views: TrainingViews, priors: Priors,
        start: np.ndarray | None = None, looks: bool = True,
    ) -> None:  # fmt: skip
        patient = replace(config, lost_after=following.lost_after, weak_after=following.weak_after)
        super().__init__(patient, views, priors, start, looks)
        self.follower = Follower(following)
        self.ahead_ms = 0.0
        self.level = 0
        self.solve_ms = following.solve_ms
        self._follows = following
        self._same = following.same.scaled(views.scale)

    def _begin(self, start: np.ndarray | None) -> None:
        super()._begin(start)
        self._kept: deque[Seen] = deque(maxlen=_KEPT_FRAMES)
        self._measured: FIFOCache[int, Measured] = FIFOCache(_KEPT_FRAMES)
        self._asked_ns: int | None = None
        self._keyframe_wanted = False
        self._keyframe: Keyframe | None = None
        self._focal = FocalCheck()
        self._filter = PoseFilter()

    def follow(self, frame: FrameInfo, image: FramePyramid | None) -> tuple[Belief, Followed | None]:
        """What is believed of a new frame, and what was measured of it; image: None for a frame that is unreadable."""
        if image is None:
            return self._not_followed(frame, Reason.FRAME_UNREADABLE), None
        self._kept.append(Seen(frame, image))
        measured = self._measure(self._kept[-1], self._starts(frame, image))
        if measured is None:
            return self._not_followed(frame, Reason.NO_CONSENSUS), None
        near = self._on_track(frame) and self._in_reach(frame, measured.followed)
        if measured.quality < (self._config.score.usable if near else self._follows.found_again):
            return self._not_followed(frame, Reason.IMPLAUSIBLE_POSE), measured.followed
        return self._believe(frame, measured), measured.followed

    def first_step(self, frame: FrameInfo) -> Step | None:
        """What to do for a frame that might be solved; None where none need be now."""
        measured = self._measured.get(frame.capture_ns)
        if not self._trust.tracked or measured is None or measured.quality < self._config.score.good:
            self._asked_ns = frame.capture_ns
            return super().first_step(frame)
        if self._keyframe_wanted:
            self._keyframe_wanted, self._keyframe = False, Keyframe(frame)
            self._asked_ns = frame.capture_ns
            return self._guess(GuessReason.MOTION, measured.followed.cam_from_object)
        ahead = self._motion.predict(frame.capture_ns + int(self._follows.ahead * self.ahead_ms * NS_PER_MS))
        if not self._due(frame.capture_ns) and self.follower.angle(ahead) < np.deg2rad(self._follows.fresh_deg):
            return None
        self._asked_ns = frame.capture_ns
        return self._guess(GuessReason.MOTION, ahead)

    def take_keyframe(self) -> None:
        """Solve the newest frame, or the next that is followed well, from where it was followed, and keep its view.

        Only where the solve bears out what was followed; a restart forgets it, but not what is kept. Raises
        RefusedError where nothing is tracked.
        """
        if not self._trust.tracked:
            raise RefusedError("the camera is not tracked, so that no view would be true; ask again once it is")
        self._keyframe_wanted = True

    def viewed(self, frame_id: int, view_id: str) -> None:
        """The view of a frame that is being solved is there, and remembered."""
        if self._keyframe is not None and self._keyframe.frame.frame_id == frame_id:
            self._keyframe = replace(self._keyframe, view_id=view_id)

    def next_step(self, attempt: Attempt, result: PoseResult) -> Step | None:
        """Following makes a pose exact and tells whether it is right, so that no further pass is needed for that."""
        if self._trust.tracked and attempt.frame.capture_ns in self._measured:
            return None
        pose = self._usable(result)
        if pose is not None and self._bears_out(attempt.frame, pose):
            return None
        return super().next_step(attempt, result)

    def conclude(self, attempt: Attempt, result: PoseResult) -> Belief:
        """A solve bears out what was followed, or speaks against it: one that is better, or two that agree, replace it.

        Where nothing was followed, its pose is believed as a VideoPolicy would, and carried on to the newest frame.
        """
        pose, capture_ns = self._usable(result), attempt.frame.capture_ns
        measured = self._measured.get(capture_ns) if self._trust.tracked else None
        self._keep_keyframe(attempt.frame, measured, pose)
        if measured is not None and not self._speaks_against(measured, capture_ns, pose, result):
            return Belief(self._trust.state, measured.quality, measured.followed.cam_from_object)
        if measured is not None:
            self._trust.lost()
        elif self._followed_since(capture_ns):
            return Belief(self._trust.state, 0.0)
        begun = self._bears_out(attempt.frame, pose) if pose is not None and not self._trust.tracked else None
        belief = super().conclude(attempt, result) if begun is None else self._believe(attempt.frame, begun)
        if belief.score > 0 and belief.cam_from_object is not None:
            self._carry_on(capture_ns, belief.cam_from_object)
        return belief

    def missed(self, frame: FrameInfo, reason: Reason) -> Belief:
        """A solve that was lost on its way says nothing of what was followed."""
        self._asked_ns = None
        return self._without_pose(frame, reason)

    def _bears_out(self, frame: FrameInfo, pose: np.ndarray) -> Measured | None:
        """What following finds of a frame at a solve's pose, if it is good and near that."""
        seen = next((seen for seen in self._kept if seen.frame.capture_ns == frame.capture_ns), None)
        measured = None if seen is None else self._measure(seen, [pose])
        if measured is None or measured.quality < self._config.score.good:
            return None
        return measured if self._far.holds(measured.followed.cam_from_object, pose) else None

    def _followed_since(self, capture_ns: int) -> bool:
        """Whether what could not be followed then was found again without the solve."""
        newest = self._measured.get(self._motion.newest_ns) if self._trust.tracked else None
        good = newest is not None and newest.quality >= self._config.score.good
        return good and self._motion.newest_ns > capture_ns

    def _on_track(self, frame: FrameInfo) -> bool:
        return self._trust.tracked and self._motion.within_horizon(frame.capture_ns)

    def _starts(self, frame: FrameInfo, image: FramePyramid) -> Iterator[np.ndarray]:
        """Where to look, the most likely first: where a prior says, where the motion leads, where the camera was.

        And where it would be if it had but turned as the whole image has shifted.
        """
        if len(self._motion) == 0:
            return
        prior = self._priors.peek(frame.frame_id)
        if prior is not None:
            yield prior
        if self._on_track(frame):
            yield self._motion.predict(frame.capture_ns)
            yield self._motion.predict(frame.capture_ns, damped=False)
        yield self._motion.newest
        before = next((seen for seen in self._kept if seen.frame.capture_ns == self._motion.newest_ns), None)
        turn = None if before is None else turned(before.image, image)
        if turn is not None:
            yield turn @ self._motion.newest

    def _measure(self, seen: Seen, starts: Iterable[np.ndarray]) -> Measured | None:
        if len(self.follower) == 0:
            return None
        followed = self.follower.follow(seen.image, starts, POINTS_BY_LEVEL[self.level])
        if followed is None:
            return None
        found = int(followed.found.sum())
        result = PoseResult(
            seen.frame.frame_id, 0, followed.cam_from_object, followed.covariance, found, len(followed.found),
            followed.residual_px,
        )  # fmt: skip
        return Measured(followed, self._quality(result))

    def _in_reach(self, frame: FrameInfo, followed: Followed) -> bool:
        reach = self._reach(frame.capture_ns - self._motion.newest_ns)
        return reach.holds(self._motion.predict(frame.capture_ns), followed.cam_from_object)

    def _believe(self, frame: FrameInfo, measured: Measured) -> Belief:
        if not self._trust.tracked:
            self._motion.reset()
            self._filter.reset()
        pose = measured.followed.cam_from_object
        self._motion.add(frame.capture_ns, pose)
        self._measured[frame.capture_ns] = measured
        if measured.quality >= self._config.score.good:
            self._trust.good()
            self._keyframes.add(pose)
        else:
            self._trust.weak()
        followed = measured.followed
        smooth, rest = self._filter.update(frame.capture_ns, pose, followed.noise)
        covariance = self._certainty.of(followed.covariance - followed.noise + rest, pose, pose)
        self._focal.note(measured.followed.focal_error, measured.followed.focal_sigma)
        return self._focal.applied(Belief(self._trust.state, measured.quality, smooth, covariance))

    def _not_followed(self, frame: FrameInfo, reason: Reason) -> Belief:
        was_tracked = self._trust.tracked
        if was_tracked:
            self._trust.rejected()
            self._prepare_relocalisation(was_tracked)
        return self._without_pose(frame, reason)

    def _due(self, capture_ns: int) -> bool:
        return self._asked_ns is None or abs(capture_ns - self._asked_ns) > self.solve_ms * NS_PER_MS

    def _speaks_against(self, measured: Measured, capture_ns: int, pose: np.ndarray | None, result: PoseResult) -> bool:
        """Whether a solve's pose is to replace what was followed."""
        if pose is None or self._same.holds(measured.followed.cam_from_object, pose):
            self._unconfirmed = None
            return False
        good = self._config.score.good
        if self._quality(result) < good:
            return False
        if measured.quality < good or self._confirms(capture_ns, pose):
            return True
        self._unconfirmed = (capture_ns, pose)
        self._asked_ns = None
        return False

    def _keep_keyframe(self, frame: FrameInfo, measured: Measured | None, pose: np.ndarray | None) -> None:
        keyframe, self._keyframe = self._keyframe, None
        if keyframe is None or keyframe.frame != frame or keyframe.view_id is None:
            return
        if measured is not None and pose is not None and self._same.holds(measured.followed.cam_from_object, pose):
            self.follower.keep(keyframe.view_id)

    def _carry_on(self, capture_ns: int, pose: np.ndarray) -> None:
        """Follow from a pose of before to the newest frame, at once where that leads there, else by way of others."""
        later = [seen for seen in self._kept if seen.frame.capture_ns > capture_ns]
        at, target = -1, len(later) - 1
        for _ in range(_HOPS):
            if target <= at:
                return
            seen = later[target]
            measured = self._measure(seen, [self._motion.predict(seen.frame.capture_ns), pose])
            if measured is None or measured.quality < self._config.score.usable:
                target = (at + target) // 2
                continue
            pose = measured.followed.cam_from_object
            self._motion.add(seen.frame.capture_ns, pose)
            self._measured[seen.frame.capture_ns] = measured
            at, target = target, len(later) - 1
