"""A source on its way: its frames as messages, each when it is due, and a note of how far it has got."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fieldpose.bus.logs import stage_logger
from fieldpose.bus.messages import Message, State
from fieldpose.bus.node import Output
from fieldpose.errors import FieldposeError, SourceError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import Feed
from fieldpose.stages.camera.progress import Progress
from fieldpose.stages.camera.sources import open_source
from fieldpose.stages.camera.wire import messages_of
from fieldpose.stages.geometry import Camera


class Sender:
    """Sends config.source, from where its progress file says. Raises FieldposeErrors where it cannot be opened."""

    def __init__(self, config: CameraConfig, known: Sequence[Camera] = ()) -> None:
        source = open_source(config, known)
        self.description = source.description
        self._progress = Progress(config.progress_file, config.source)
        self._feed = Feed(source, config, self._progress.next)
        self._error: FieldposeError | None = None
        self._held_up_ns = 0
        self._noted = True

    def messages(self, now_ns: int) -> Iterator[Output]:
        """What is to be sent now; progress is noted after each frame."""
        try:
            for frame, capture_ns in self._feed.due(now_ns):
                yield from messages_of(frame, capture_ns)
                self._note_progress()
            if self._feed.held_up_ns > self._held_up_ns:
                by_s = round((self._feed.held_up_ns - self._held_up_ns) * 1e-9, 1)
                stage_logger("camera").warning("frames were due earlier and go on from here", seconds=by_s)
                self._held_up_ns = self._feed.held_up_ns
        except (FieldposeError, OSError) as error:
            self._error = error if isinstance(error, FieldposeError) else SourceError(str(error))

    def _note_progress(self) -> None:
        """A full disk ends no camera: it is only where a camera that is started again would go on."""
        try:
            self._progress.advance()
        except OSError as error:
            if self._noted:
                stage_logger("camera").warning("where it has got to cannot be noted", error=str(error))
            self._noted = False
        else:
            self._noted = True

    def wait_s(self, now_ns: int) -> float | None:
        """How long until the next frame is due; None where that is not known."""
        return self._feed.wait_s(now_ns)

    def heard(self, message: Message, now_ns: int, object: str | None = None) -> None:
        """Take in a State, Pose or Failure of an object: a frame is answered, or a pass over it has come back."""
        if isinstance(message, State):
            self._feed.answered(message.header.frame_id, message.in_flight, now_ns, object)
        else:
            self._feed.sign_of_life(message.header.frame_id, now_ns)

    def over(self, now_ns: int) -> bool:
        """Whether nothing more will come: all is sent and answered, or the source cannot be read on."""
        return self._error is not None or self._feed.over(now_ns)

    def close(self) -> None:
        """Let go of the source. Raises the FieldposeError that ended it early, if one did."""
        self._feed.close()
        if self._error is not None:
            raise self._error
