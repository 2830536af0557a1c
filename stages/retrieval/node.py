"""Retrieval as a process: frames for which tracking has to search in, the training views most like them out."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import cast

import numpy as np

from fieldpose.bus.logs import stage_logger
from fieldpose.bus.messages import Frame, Guess, GuessReason, Header, Message, Reason, Retrieved
from fieldpose.bus.node import JoinedHandler, Output, reply_header
from fieldpose.bus.topics import FRAME, GUESS, RETRIEVED, Topic
from fieldpose.stages.errors import WeightsError
from fieldpose.stages.matching.core import MatchingConfig
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.retrieval.config import RetrievalConfig
from fieldpose.stages.retrieval.core import Retriever, describer
from fieldpose.stages.tracking.views import training_views
from fieldpose.stages.wire import frame_image

_ANSWERED = 64


class RetrievalNode(JoinedHandler):
    """Answers the first guess for a frame that is a search. Raises FieldFileError at start.

    Idle where the field does not remember its training views, or without weights: tracking then searches without it.
    """

    name = "retrieval"
    inputs: tuple[Topic, ...] = (GUESS, FRAME)
    outputs: tuple[Topic, ...] = (RETRIEVED,)

    def __init__(self, field: Path, config: RetrievalConfig, matching: MatchingConfig) -> None:
        super().__init__()
        self._field, self._config, self._matching = field, config, matching
        self._retriever: Retriever | None = None
        self._answered: deque[tuple[int, int]] = deque(maxlen=_ANSWERED)

    def start(self) -> None:
        views = training_views(load_field(self._field))
        if views.descriptors is None or self._config.candidates == 0:
            return
        try:
            self._describe = describer(self._matching, views.size, self._config.keypoints)
        except WeightsError as error:
            stage_logger(self.name).warning("off", reason=str(error))
            return
        self._describe(np.zeros((64, 64, 3), np.uint8))  # the first inference is slow
        self._poses = views.cam_from_object
        self._retriever = Retriever(views.descriptors, self._config)

    def handle(self, topic: Topic, message: Message) -> Iterator[Output]:
        if self._retriever is not None and (topic is not GUESS or self._wanted(cast(Guess, message))):
            yield from super().handle(topic, message)

    def process(self, joined: dict[Topic, Message]) -> Iterable[Output]:
        guess, image = cast(Guess, joined[GUESS]), frame_image(cast(Frame, joined[FRAME]))
        if image is None or self._retriever is None:
            yield from self.failure(guess.header, Reason.FRAME_UNREADABLE)
            return
        ranking = self._retriever.rank(self._describe(image))
        yield RETRIEVED, Retrieved(
            header=reply_header(guess.header), ok=True, reason=Reason.OK,
            cam_from_object=self._poses[ranking.index], similarity=ranking.similarity,
        )  # fmt: skip

    def failure(self, header: Header, reason: Reason) -> Iterable[Output]:
        yield RETRIEVED, Retrieved(
            header=reply_header(header), ok=False, reason=reason,
            cam_from_object=np.zeros((0, 4, 4)), similarity=np.zeros(0, np.float32),
        )  # fmt: skip

    def _wanted(self, guess: Guess) -> bool:
        """Whether it is a search, and the first for its frame."""
        frame = (guess.header.frame_id, guess.header.capture_ns)
        wanted = guess.reason is GuessReason.RELOCALISATION and frame not in self._answered
        if wanted:
            self._answered.append(frame)
        return wanted
