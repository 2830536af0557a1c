"""Training views that look like an image, in one process."""

from __future__ import annotations

import numpy as np

from deploy.settings import Settings
from stages.geometry import Camera
from stages.matching.core import PairMatcher
from stages.rendering.core import view_camera
from stages.retrieval.core import Describe, Retriever, describer
from stages.tracking.views import TrainingViews


class Lookalikes:
    """Finds them by the features that are matched anyway, where these are XFeat's of the right size."""

    def __init__(self, views: TrainingViews, settings: Settings, pairs: PairMatcher) -> None:
        self._poses, self._settings, self._pairs = views.cam_from_object, settings, pairs
        self._retriever: Retriever | None = None
        if views.descriptors is not None and settings.retrieval.candidates > 0:
            self._retriever = Retriever(views.descriptors, settings.retrieval)
        self._describe: Describe | None = None

    def of(self, image: np.ndarray, camera: Camera, image_key: int) -> list[np.ndarray]:
        """cam_from_object of the training views, the most alike first; none if the field does not know how they look.

        Raises WeightsError.
        """
        if self._retriever is None:
            return []
        ranking = self._retriever.rank(self._descriptors(image, camera, image_key))
        return list(self._poses[ranking.index])

    def _descriptors(self, image: np.ndarray, camera: Camera, image_key: int) -> np.ndarray:
        small, config = view_camera(camera, self._settings.rendering.longer_side), self._settings.retrieval
        longer_side = max(small.width, small.height)
        if self._settings.matching.matcher == "xfeat" and longer_side == config.size:
            descriptors: np.ndarray = self._pairs.frame_features(image, longer_side, image_key).data.cpu().numpy()
            return descriptors
        if self._describe is None:
            self._describe = describer(config, self._settings.matching, config.keypoints)
        return self._describe(image)
