"""The one table of what is written and served: every channel's topic, and the schema of its messages.

Channels of Foxglove's own schemas have protobuf messages, those of figures JSON.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
from foxglove import messages

from fieldpose.deploy.foxglove import figures


@dataclass(frozen=True)
class Channel:
    """picture: its messages are large and costly to make, and a viewer needs no more than some a second."""

    topic: str
    kind: type[Any]
    picture: bool = False

    @property
    def encoding(self) -> str:
        """How its messages are encoded."""
        return "json" if issubclass(self.kind, msgspec.Struct) else "protobuf"

    @property
    def schema(self) -> tuple[str, str, bytes]:
        """Its schema's name, encoding and bytes."""
        if issubclass(self.kind, msgspec.Struct):
            return f"fieldpose.{self.kind.__name__}", "jsonschema", figures.schema_of(self.kind)
        schema = self.kind.get_schema()
        return schema.name, schema.encoding, schema.data


IMAGE = Channel("/camera/image", messages.CompressedImage, picture=True)
CALIBRATION = Channel("/camera/calibration", messages.CameraCalibration)
MATCHES = Channel("/camera/matches", messages.ImageAnnotations)
CORRESPONDENCES = Channel("/camera/correspondences", messages.ImageAnnotations)
INLIERS = Channel("/camera/inliers", messages.ImageAnnotations)
FOLLOWED = Channel("/camera/followed", messages.ImageAnnotations)
CAPTION = Channel("/camera/state", messages.ImageAnnotations)
VIEW_IMAGE = Channel("/view/image", messages.CompressedImage, picture=True)
VIEW_DEPTH = Channel("/view/depth", messages.RawImage, picture=True)
VIEW_CALIBRATION = Channel("/view/calibration", messages.CameraCalibration)
VIEW_MATCHES = Channel("/view/matches", messages.ImageAnnotations)
GUESS_CALIBRATION = Channel("/guess/calibration", messages.CameraCalibration)
TRANSFORMS = Channel("/tf", messages.FrameTransforms)
POSE = Channel("/pose", messages.PoseInFrame)
UNSURE = Channel("/pose/unsure", messages.PoseInFrame)
GUESS = Channel("/pose/guess", messages.PoseInFrame)
PRIOR = Channel("/pose/prior", messages.PoseInFrame)
TRUTH = Channel("/pose/truth", messages.PoseInFrame)
PATH = Channel("/path", messages.PosesInFrame)
POINTS = Channel("/points", messages.PointCloud)
LOG = Channel("/log", messages.Log)
STATE = Channel("/state", figures.StateFigures)
SOLVED_FIGURES = Channel("/solved", figures.SolvedFigures)
FOLLOWED_FIGURES = Channel("/followed", figures.FollowedFigures)
STATS = Channel("/stats", figures.StatsFigures)

ALL: tuple[Channel, ...] = (
    IMAGE, CALIBRATION, MATCHES, CORRESPONDENCES, INLIERS, FOLLOWED, CAPTION, VIEW_IMAGE, VIEW_DEPTH, VIEW_CALIBRATION,
    VIEW_MATCHES, GUESS_CALIBRATION, TRANSFORMS, POSE, UNSURE, GUESS, PRIOR, TRUTH, PATH, POINTS, LOG, STATE,
    SOLVED_FIGURES, FOLLOWED_FIGURES, STATS,
)  # fmt: skip
