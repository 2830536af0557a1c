"""What the handlers of one process are made of: loaded when it is first asked for, and shared by those that need it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fieldpose.bus.messages import Frame
from fieldpose.deploy.plan import Plan
from fieldpose.errors import UsageError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.lifting.memory import ConsistencyMemory
from fieldpose.stages.wire import FrameImages

# A process imports what its own handlers need, and no more: torch and numba take seconds.
if TYPE_CHECKING:
    from fieldpose.stages.following.wire import See
    from fieldpose.stages.matching.core import PairMatcher
    from fieldpose.stages.nerf.field import Field
    from fieldpose.stages.nerf.rendering_api import RayRenderer
    from fieldpose.stages.nerf.training_views import TrainingViews
    from fieldpose.stages.rendering.core import ViewSource
    from fieldpose.stages.retrieval.node import DescribeFrame
    from fieldpose.stages.tracking.core import Tracker
    from fieldpose.stages.tracking.following import FollowingTracker

_KEPT_VIEWS = 128


class Parts:
    """What a plan's handlers are made of; `renderer` and `views` stand in for what the field's file has.

    together: all stages are in this process, so that what one has found out of a frame serves another. What it gives
    raises UsageError where no field was given, FieldFileError, ConfigError and WeightsError.
    """

    def __init__(
        self, plan: Plan, threads: int = 0, renderer: RayRenderer | None = None, views: TrainingViews | None = None,
        together: bool = False,
    ) -> None:  # fmt: skip
        self.plan, self.settings = plan, plan.settings
        self._threads, self._renderer, self._training_views, self._together = threads, renderer, views, together
        self.images = FrameImages()
        self.consistency = ConsistencyMemory(max(_KEPT_VIEWS, 0 if views is None else len(views.names)))

    @cached_property
    def field(self) -> Field:
        """The field of the plan."""
        from fieldpose.stages.nerf.field import load_field

        if self.plan.field is None:
            raise UsageError("this process needs --field FIELD")
        return load_field(self.plan.field)

    @cached_property
    def training_views(self) -> TrainingViews:
        """Its training views."""
        from fieldpose.stages.nerf.training_views import training_views

        return self._training_views or training_views(self.field)

    def known_cameras(self) -> Sequence[Camera]:
        """The cameras of its training views; none where this process has no field."""
        return [] if self.plan.field is None else [view.camera for view in self.field.metadata.cameras]

    @cached_property
    def renderer(self) -> RayRenderer:
        """Renders the field, without delay."""
        if self._renderer is not None:
            return self._renderer
        from fieldpose.stages.nerf.loading import make_renderer, warm_up

        config = self.settings.refinement
        renderer = make_renderer(self.field, self._threads, self.settings.backend)
        warm_up(renderer, jacobian=config.needs_jacobian)
        return renderer

    @cached_property
    def views(self) -> ViewSource:
        """Its views."""
        from fieldpose.stages.rendering.core import ViewSource

        path = self.plan.field
        field_id = "" if path is None else hashlib.sha256(path.read_bytes()).hexdigest()
        return ViewSource(self.renderer, self.settings.rendering, field_id)

    @cached_property
    def pairs(self) -> PairMatcher:
        """Matches views with frames; so that a photo's result depends on no other, always one image at a time."""
        from fieldpose.stages.matching.core import PairMatcher, build_matcher

        self._limit_torch()
        return PairMatcher(build_matcher(self.settings.matching), self.settings.matching, not self.plan.independent)

    def see(self) -> See | None:
        """How following looks at frames; None where none are followed."""
        from fieldpose.stages.following.wire import small_frame

        longer_side = self.settings.rendering.longer_side
        return (lambda frame: small_frame(frame, longer_side)) if self.plan.follows else None

    def describe(self) -> DescribeFrame:
        """What retrieval compares frames by; by the features that are matched anyway, where these are the same."""
        from fieldpose.stages.rendering.core import view_camera

        self._limit_torch()
        size, matching = self.training_views.size, self.settings.matching
        shared = self._together and matching.matcher == "xfeat"
        if not shared:
            _ = self._describer

        def describe(image: np.ndarray, frame: Frame) -> np.ndarray:
            small = view_camera(frame.camera, self.settings.rendering.longer_side)
            matched, given = matching.frame_size or max(small.width, small.height), max(image.shape[:2])
            if shared and min(matched, given) == min(size, given):
                features = self.pairs.frame_features(image, matched, frame.header.frame_key)
                descriptors: np.ndarray = features.data.cpu().numpy()
                return descriptors
            return self._describer(image)

        return describe

    def tracker(self) -> Tracker | FollowingTracker:
        """Tracking, for the kind of sequence that the plan has."""
        from fieldpose.stages.tracking.beginning import make_followed_policy, make_policy
        from fieldpose.stages.tracking.core import Tracker
        from fieldpose.stages.tracking.following import FollowingTracker

        config, following = self.settings.tracking, self.settings.following
        if self.plan.follows:
            policy = make_followed_policy(config, following, self.training_views, self.plan.looks)
            return FollowingTracker(config, following, policy, patient=self.settings.camera.pace == "lockstep")
        return Tracker(config, make_policy(config, self.training_views, self.plan.looks))

    @cached_property
    def _describer(self) -> Callable[[np.ndarray], np.ndarray]:
        from fieldpose.stages.retrieval.core import describer

        size = self.training_views.size
        describe = describer(self.settings.matching, size, self.settings.retrieval.keypoints)
        describe(np.zeros((64, 64, 3), np.uint8))  # the first inference is slow
        return describe

    def _limit_torch(self) -> None:
        if self._threads:
            import torch

            torch.set_num_threads(self._threads)
