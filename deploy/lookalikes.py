"""Training views that look like an image, in one process."""

from __future__ import annotations

import numpy as np

from fieldpose.bus.logs import stage_logger
from fieldpose.deploy.settings import Settings
from fieldpose.stages.errors import WeightsError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.matching.core import PairMatcher
from fieldpose.stages.rendering.core import view_camera
from fieldpose.stages.retrieval.core import Describe, Retriever, describer
from fieldpose.stages.tracking.views import TrainingViews


class Lookalikes:
    """Finds them by the features that are matched anyway, where these are XFeat's of the right size."""

    def __init__(self, views: TrainingViews, settings: Settings, pairs: PairMatcher) -> None:
        self._poses, self._size, self._settings, self._pairs = views.cam_from_object, views.size, settings, pairs
        self._retriever: Retriever | None = None
        if views.descriptors is not None and settings.retrieval.candidates > 0:
            self._retriever = Retriever(views.descriptors, settings.retrieval)
        self._describe: Describe | None = None

    def of(self, image: np.ndarray, camera: Camera, image_key: int, needed: bool) -> list[np.ndarray]:
        """cam_from_object of the training views, the most alike first; none if the field does not know how they look.

        Nor are there any without weights: where the views are needed WeightsError is raised, else it is said once.
        """
        if self._retriever is None:
            return []
        try:
            descriptors = self._descriptors(image, camera, image_key)
        except WeightsError as error:
            if needed:
                raise
            stage_logger("retrieval").warning("off", reason=str(error))
            self._retriever = None
            return []
        return list(self._poses[self._retriever.rank(descriptors).index])

    def _descriptors(self, image: np.ndarray, camera: Camera, image_key: int) -> np.ndarray:
        matching, small = self._settings.matching, view_camera(camera, self._settings.rendering.longer_side)
        matched = matching.frame_size or max(small.width, small.height)
        given = max(image.shape[:2])
        if matching.matcher == "xfeat" and min(matched, given) == min(self._size, given):
            descriptors: np.ndarray = self._pairs.frame_features(image, matched, image_key).data.cpu().numpy()
            return descriptors
        if self._describe is None:
            self._describe = describer(matching, self._size, self._settings.retrieval.keypoints)
        return self._describe(image)
