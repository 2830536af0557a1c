"""Retrieval as a process: which training views look most like a frame that tracking has to search for."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fieldpose.bus.logs import stage_logger
from fieldpose.bus.messages import Frame, Message, Reason, Retrieved
from fieldpose.bus.node import Joined, JoinedHandler
from fieldpose.bus.topics import FRAME, RETRIEVED, SEARCH
from fieldpose.errors import WeightsError
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.retrieval.config import RetrievalConfig
from fieldpose.stages.retrieval.core import Retriever
from fieldpose.stages.wire import FrameImages

DescribeFrame = Callable[[np.ndarray, Frame], np.ndarray]
"""The image (h, w, 3) uint8 of a frame, and the frame -> its strongest keypoints' descriptors (n, 64) float32."""


class RetrievalNode(JoinedHandler):
    """Answers each search; NOT_AVAILABLE where the field does not know how its views look, or without weights."""

    name = "retrieval"
    inputs = (SEARCH, FRAME)
    output = RETRIEVED

    def __init__(
        self, make_views: Callable[[], TrainingViews], make_describe: Callable[[], DescribeFrame],
        config: RetrievalConfig, images: FrameImages,
    ) -> None:  # fmt: skip
        super().__init__()
        self._make_views, self._make_describe, self._config, self._images = make_views, make_describe, config, images
        self._retriever: Retriever | None = None

    def start(self) -> None:
        views = self._make_views()
        if views.descriptors is None or self._config.candidates == 0:
            return
        try:
            self._describe = self._make_describe()
        except WeightsError as error:
            stage_logger(self.name).warning("off", reason=str(error))
            return
        self._poses, self._retriever = views.cam_from_object, Retriever(views.descriptors, self._config)

    def answer(self, joined: Joined) -> Message | Reason:
        if self._retriever is None:
            return Reason.NOT_AVAILABLE
        image = self._images.of(joined[FRAME])
        if image is None:
            return Reason.FRAME_UNREADABLE
        ranking = self._retriever.rank(self._describe(image, joined[FRAME]))
        if len(ranking.index) == 0:
            return Reason.NOTHING_ALIKE
        poses = self._poses[ranking.index]
        return Retrieved(header=joined.header, cam_from_object=poses, similarity=ranking.similarity)
