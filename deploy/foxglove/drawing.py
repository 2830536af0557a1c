"""Values of this project as Foxglove's messages.

The frame `object` is the root; cameras below it have the axes x right, y down, z forward in both. Pixel (0, 0) is the
centre of the top-left pixel here and in calibrations, as in OpenCV and ROS; in annotations it is that pixel's corner.
Source: the descriptions in Foxglove's schemas.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import accumulate

import cv2
import numpy as np
from foxglove import messages
from foxglove.messages import PackedElementFieldNumericType as Numeric
from foxglove.messages import PointsAnnotationType
from scipy.spatial.transform import Rotation

from fieldpose.bus.messages import Correspondences, Encoding
from fieldpose.errors import OutputError
from fieldpose.stages.geometry import Camera, inverse

ROOT, CAMERA, UNSURE, GUESS, TRUTH, VIEW = (
    "object", "camera", "camera_unsure", "camera_guess", "camera_truth", "view",
)  # fmt: skip

Colour = tuple[float, float, float]
GREEN, RED, BLUE, ORANGE, GREY = (
    (0.2, 0.85, 0.3), (0.95, 0.2, 0.2), (0.25, 0.55, 1.0), (1.0, 0.6, 0.1), (0.6, 0.6, 0.6),
)  # fmt: skip

_NS = 1_000_000_000
_STAMPS_NS = 2**32 * _NS
_LARGEST_JPEG = 65_500
_CORNER = 0.5
_POINT_PX, _FONT_PX = 4.0, 14.0
_CLOUD = (
    ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1"),
    ("confidence", "<f4"), ("consistency", "<f4"), ("kept", "u1"),
)  # fmt: skip
_NUMERIC = {"<f4": Numeric.Float32, "u1": Numeric.Uint8}


def stamp(at_ns: int) -> messages.Timestamp:
    """A time since the epoch. Raises OutputError for one that Foxglove's messages cannot hold."""
    if at_ns >= _STAMPS_NS:
        raise OutputError(f"a time of {at_ns} ns since the epoch is later than Foxglove's messages can say")
    return messages.Timestamp(sec=at_ns // _NS, nsec=at_ns % _NS)


def pose(cam_from_object: np.ndarray) -> messages.Pose:
    """The camera's pose in the object's frame."""
    position, turn = _placed(cam_from_object)
    return messages.Pose(position=position, orientation=turn)


def pose_in_object(cam_from_object: np.ndarray, at_ns: int) -> messages.PoseInFrame:
    return messages.PoseInFrame(timestamp=stamp(at_ns), frame_id=ROOT, pose=pose(cam_from_object))


def path_in_object(poses: Iterable[messages.Pose], at_ns: int) -> messages.PosesInFrame:
    return messages.PosesInFrame(timestamp=stamp(at_ns), frame_id=ROOT, poses=list(poses))


def transform(cam_from_object: np.ndarray, child: str, at_ns: int) -> messages.FrameTransforms:
    """Where the camera of the frame `child` is below the root."""
    position, turn = _placed(cam_from_object)
    one = messages.FrameTransform(
        timestamp=stamp(at_ns), parent_frame_id=ROOT, child_frame_id=child, translation=position, rotation=turn
    )
    return messages.FrameTransforms(transforms=[one])


def calibration(camera: Camera, frame: str, at_ns: int) -> messages.CameraCalibration:
    matrix = camera.matrix()
    return messages.CameraCalibration(
        timestamp=stamp(at_ns),
        frame_id=frame,
        width=camera.width,
        height=camera.height,
        distortion_model="plumb_bob",
        D=list(camera.distortion),
        K=matrix.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.pad(matrix, ((0, 0), (0, 1))).ravel().tolist(),
    )


def image(pixels: np.ndarray, encoding: Encoding, frame: str, at_ns: int) -> messages.CompressedImage:
    """pixels: (h, w, 3) uint8 RGB, which become a JPEG, or the bytes (n,) of a file, which stay. Raises OutputError."""
    content, kind = pixels, encoding
    if encoding == "rgb8":
        if not 0 < min(pixels.shape) <= max(pixels.shape) <= _LARGEST_JPEG:
            raise OutputError(f"an image of {pixels.shape[1]}x{pixels.shape[0]} pixels cannot be written as a JPEG")
        _, content = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))
        kind = "jpeg"
    return messages.CompressedImage(timestamp=stamp(at_ns), frame_id=frame, data=content.tobytes(), format=kind)


def depth(depths: np.ndarray, frame: str, at_ns: int) -> messages.RawImage:
    """depths: (h, w) float32 along the optical axis, in field units, which stay as they are."""
    height, width = depths.shape
    content = np.ascontiguousarray(depths, "<f4").tobytes()
    return messages.RawImage(
        timestamp=stamp(at_ns), frame_id=frame, width=width, height=height, encoding="32FC1", step=4 * width,
        data=content,
    )  # fmt: skip


def marked(groups: Iterable[tuple[str, np.ndarray, Colour]], at_ns: int) -> messages.ImageAnnotations:
    """Points on an image: what they are, their pixels (n, 2), their colour; a group without points is left out."""
    points = [
        messages.PointsAnnotation(
            timestamp=stamp(at_ns),
            type=PointsAnnotationType.Points,
            points=[messages.Point2(x=x, y=y) for x, y in (pixels.astype(np.float64) + _CORNER).tolist()],
            outline_color=_colour(colour),
            thickness=_POINT_PX,
            metadata=[messages.KeyValuePair(key="what", value=what)],
        )
        for what, pixels, colour in groups
        if len(pixels)
    ]
    return messages.ImageAnnotations(timestamp=stamp(at_ns), points=points)


def caption(text: str, colour: Colour, at_ns: int) -> messages.ImageAnnotations:
    """A line of text in the image's top-left corner."""
    line = messages.TextAnnotation(
        timestamp=stamp(at_ns), position=messages.Point2(x=4.0, y=4.0 + _FONT_PX), text=text, font_size=_FONT_PX,
        text_color=_colour(colour), background_color=messages.Color(r=0.0, g=0.0, b=0.0, a=0.6),
    )  # fmt: skip
    return messages.ImageAnnotations(timestamp=stamp(at_ns), texts=[line])


def cloud(found: Correspondences, at_ns: int) -> messages.PointCloud:
    """Points in the object's frame, those kept green and the discarded ones red, with what was known of each."""
    rows = np.zeros(len(found.kept), np.dtype(list(_CLOUD)))
    rows["x"], rows["y"], rows["z"] = found.points_in_object.T
    colours = np.where(found.kept[:, None], GREEN, RED)
    rows["red"], rows["green"], rows["blue"] = np.rint(255 * colours).astype(np.uint8).T
    rows["alpha"], rows["kept"] = 255, found.kept
    rows["confidence"], rows["consistency"] = found.confidence, found.consistency
    ends = accumulate((np.dtype(kind).itemsize for _, kind in _CLOUD), initial=0)
    fields = [
        messages.PackedElementField(name=name, offset=offset, type=_NUMERIC[kind])
        for (name, kind), offset in zip(_CLOUD, ends, strict=False)
    ]
    origin = messages.Pose(position=messages.Vector3(), orientation=messages.Quaternion(w=1.0))
    return messages.PointCloud(
        timestamp=stamp(at_ns), frame_id=ROOT, pose=origin, point_stride=rows.itemsize, fields=fields,
        data=rows.tobytes(),
    )  # fmt: skip


def log(text: str, level: messages.LogLevel, name: str, at_ns: int) -> messages.Log:
    return messages.Log(timestamp=stamp(at_ns), level=level, message=text, name=name)


def _placed(cam_from_object: np.ndarray) -> tuple[messages.Vector3, messages.Quaternion]:
    object_from_cam = inverse(cam_from_object)
    x, y, z = object_from_cam[:3, 3].tolist()
    i, j, k, w = Rotation.from_matrix(object_from_cam[:3, :3]).as_quat(canonical=True).tolist()
    return messages.Vector3(x=x, y=y, z=z), messages.Quaternion(x=i, y=j, z=k, w=w)


def _colour(colour: Colour) -> messages.Color:
    r, g, b = colour
    return messages.Color(r=r, g=g, b=b, a=1.0)
