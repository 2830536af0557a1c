"""Edited sequences as recordings: making them, and reading what became of each frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import msgspec
import numpy as np

from fieldpose.bus.mcap_files import Attachment
from fieldpose.bus.open_recording import partial_path
from fieldpose.bus.reading import info, read_attachment
from fieldpose.bus.recording import RecordingWriter
from fieldpose.deploy.evaluation.edits import edit_of, parameters_of
from fieldpose.deploy.evaluation.film import FrameLog
from fieldpose.deploy.evaluation.shots import NS_PER_S, Shot, shots_of
from fieldpose.deploy.reporting.provenance import EDIT_RECORD
from fieldpose.errors import OutputError, RecordingError, SourceError, UsageError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame
from fieldpose.stages.camera.sources import open_source
from fieldpose.stages.images import decoded, shrunk_with_camera

EDIT_ATTACHMENT = "edit.json"

Report = Callable[[int, int], None]


class EditedFrame(msgspec.Struct, frozen=True):
    """What became of a frame: `visible` is the share of its image, 0 to 1, that still shows the scene.

    That is the share that the edit leaves of the source's image, 0 where by its truth the object is out of view; what
    stands in front in the source itself is not known. source_frame_id: its number in the source. edited: the edit shows
    here; Shot tells what counts.
    """

    frame_id: int
    source_frame_id: int
    visible: float
    edited: bool


@dataclass(frozen=True)
class Recipe:
    """Which part of a sequence is edited, by which seed, and how its images are kept. UsageError for bad numbers."""

    seed: int = 0
    """The same seed gives the same frames."""
    start: float = 0.0
    """Begin so many seconds after the first frame."""
    seconds: float | None = None
    """Take so many seconds of the source."""
    every: int = 1
    """Take every n-th frame; stamps stay as they are."""
    frames: int | None = None
    """Take at most so many frames."""
    size: int | None = None
    """Shrink images whose longer side has more pixels, after the edit."""
    quality: int = 92
    """JPEG quality of images that are changed; others stay as they are, to the byte."""

    def __post_init__(self) -> None:
        if self.seed < 0 or not 0 <= self.start < float("inf"):
            raise UsageError("--seed and --start must be 0 or more")
        for name in ("seconds", "every", "frames", "size"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise UsageError(f"--{name} is {value}, but must be more than 0")
        if not 1 <= self.quality <= 100:
            raise UsageError(f"--quality is {self.quality}, but must lie between 1 and 100")

    def chosen(self, frames: Iterator[CapturedFrame]) -> Iterator[CapturedFrame]:
        """The frames of the part."""
        return islice(islice(self._within(frames), 0, None, self.every), self.frames)

    def _within(self, frames: Iterator[CapturedFrame]) -> Iterator[CapturedFrame]:
        begin_ns = None
        for frame in frames:
            at_ns = frame.at_ns or 0
            begin_ns = at_ns if begin_ns is None else begin_ns
            elapsed_s = (at_ns - begin_ns) / NS_PER_S - self.start
            if self.seconds is not None and elapsed_s >= self.seconds:
                return
            if elapsed_s >= 0:
                yield frame


class EditRecord(msgspec.Struct, frozen=True):
    """How an edited sequence was made, from which file, and its frames in the order of sending."""

    edit: str
    parameters: dict[str, float]
    source: str
    recipe: Recipe
    frames: list[EditedFrame]


def read_edit(path: Path | str) -> EditRecord:
    """How an edited sequence was made. Raises RecordingError for a file that is none."""
    try:
        return msgspec.json.decode(read_attachment(path, EDIT_ATTACHMENT), type=EditRecord)
    except msgspec.DecodeError as error:
        raise RecordingError(f"{path}: {EDIT_ATTACHMENT} is of another version: {error}") from error


def read_visibility(path: Path | str) -> dict[int, float]:
    """By frame_id the share of each image, 0 to 1, that shows the scene. Raises RecordingError for other recordings."""
    return {frame.frame_id: frame.visible for frame in read_edit(path).frames}


def edit_recording(
    source: Path, out: Path, name: str, recipe: Recipe, report: Report = lambda done, total: None
) -> EditRecord:
    """Write an edited version of the camera frames of a recording, whose chosen part is held in memory as it is stored.

    Raises UsageError for an unknown edit or a part that does not suit it, SourceError, OutputError and RecordingError;
    then nothing is left behind.
    """
    edit = edit_of(name)
    if out.exists():
        raise OutputError(f"{out}: is there already; name another file with --out")
    shots = edit(_part(source, recipe), np.random.default_rng(recipe.seed))
    record = EditRecord(name, parameters_of(edit), source.name, recipe, [])
    with _new_recording(out, record) as writer:
        log = FrameLog(writer)
        for shot in shots:
            frame, visible = _finished(shot, recipe)
            log.write(frame)
            record.frames.append(EditedFrame(frame.frame_id, shot.source_id, visible, shot.edited))
            report(len(record.frames), len(shots))
    return record


def _part(source: Path, recipe: Recipe) -> list[Shot]:
    """The frames to edit."""
    frames = open_source(CameraConfig(f"mcap:{source}")).frames(0)
    if EDIT_ATTACHMENT in info(source).attachments:
        raise SourceError(f"{source}: is an edited sequence; edit the one that it was made from")
    shots = shots_of(recipe.chosen(frames))
    if not shots:
        raise UsageError(f"{source}: no frames in the part chosen; `fieldpose info` tells how long it lasts")
    return shots


@contextmanager
def _new_recording(out: Path, record: EditRecord) -> Iterator[RecordingWriter]:
    """A recording with the record of its edit, as it is in the end; none where anything goes wrong."""
    told = {"edit": record.edit, "seed": str(record.recipe.seed), "source": record.source}
    told |= {name: str(value) for name, value in record.parameters.items()}
    writer = RecordingWriter(out, {EDIT_RECORD: told})
    try:
        yield writer
        writer.add(attachments=[Attachment(EDIT_ATTACHMENT, "application/json", msgspec.json.encode(record))])
        writer.close()
    except BaseException as error:
        with suppress(OSError):
            writer.discard()
        # A full disk keeps `discard` from getting so far.
        partial_path(out).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"{out}: cannot be written: {error.strerror}") from error
        raise


def _finished(shot: Shot, recipe: Recipe) -> tuple[CapturedFrame, float]:
    """The frame as it is sent, and the share of its image that shows the scene."""
    frame, camera = shot.frame, shot.frame.camera
    out_of_view = frame.truth is not None and frame.truth.cam_from_object is None
    larger = recipe.size is not None and max(camera.width, camera.height) > recipe.size
    visible = 1.0
    if shot.repaint is not None or larger:
        image = decoded(frame.encoding, frame.image, camera.width, camera.height)
        if image is None:
            raise SourceError(f"the {frame.encoding} image of frame {shot.source_id} cannot be read")
        if shot.repaint is not None:
            image, visible = shot.repaint(image)
        small, camera = shrunk_with_camera(image, camera, recipe.size)
        frame = replace(frame, image=_jpeg(small, recipe.quality), encoding="jpeg", camera=camera)
    return frame, 0.0 if out_of_view else visible


def _jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    """The bytes (n,) uint8 of an image (h, w, 3) uint8 RGB as a file."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].ravel()
