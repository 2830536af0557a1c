"""Store the rendered sequence as a recording: the camera's frames, and the true pose of each.

Run with the project's own environment, on what `make_scene.py --part sequence` wrote:

    .venv/bin/python recordings/demo/make_recording.py /tmp/sequence recordings/demo/sequence.mcap
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from fieldpose.bus.messages import Frame, Header, Truth
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import FRAME, TRUTH, Address
from fieldpose.stages.geometry import Camera

SOURCE = "camera"
STARTED_NS = 1_750_000_000_000_000_000
OPENCV_FROM_OPENGL = np.diag((1.0, -1.0, -1.0, 1.0))


def cam_from_object(frame: dict[str, Any]) -> np.ndarray:
    """The 4x4 pose in OpenCV axes; the object's frame is the world of the transforms file."""
    world_from_cam = np.array(frame["transform_matrix"], np.float64)
    return np.ascontiguousarray(OPENCV_FROM_OPENGL @ np.linalg.inv(world_from_cam))


def camera_model(poses: dict[str, Any]) -> Camera:
    return Camera(poses["w"], poses["h"], poses["fl_x"], poses["fl_y"], poses["cx"], poses["cy"])


def jpeg(path: Path, quality: int) -> np.ndarray:
    """(n,) uint8, the picture at `path` as a JPEG file."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        sys.exit(f"{path}: cannot be read; render it with make_scene.py --part sequence")
    settings = (cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    return cv2.imencode(".jpg", image, settings)[1].ravel()


def write(folder: Path, out: Path, quality: int) -> None:
    poses = json.loads((folder / "poses.json").read_text())
    camera, address = camera_model(poses), Address()
    about = {key: str(poses[key]) for key in ("metres_per_unit", "rate_hz")}
    writer = RecordingWriter(out, {"fieldpose.scene": about | {"object_frame": "world of transforms_train.json"}})
    for i, frame in enumerate(poses["frames"]):
        now_ns = STARTED_NS + round(i * 1e9 / poses["rate_hz"])
        header = Header(SOURCE, i, i, 0, now_ns, now_ns)
        truth = Truth(header=header, cam_from_object=cam_from_object(frame))
        writer.write(address.key(TRUTH), TRUTH, truth, now_ns)
        image = jpeg(folder / frame["file_path"], quality)
        captured = Frame(header=header, image=image, encoding="jpeg", camera=camera)
        writer.write(address.key(FRAME), FRAME, captured, now_ns)
    if not writer.close():
        sys.exit(f"{out}: the recording is not whole")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with poses.json and the rendered frames")
    parser.add_argument("out", type=Path)
    parser.add_argument("--quality", type=int, default=60, help="of the JPEG frames")
    options = parser.parse_args()
    write(options.folder, options.out, options.quality)


if __name__ == "__main__":
    main()
