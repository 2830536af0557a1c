"""Frames of one's own camera for a running pipeline: python examples/publish_frames.py VIDEO CAMERA.json [HUB]

Start the pipeline first: fieldpose run FIELD --source bus --listen tcp/127.0.0.1:7447
CAMERA.json has width, height, fx, fy, cx, cy in pixels. In place of OpenCV's capture, use your own camera's code.
"""

import sys
import time
from pathlib import Path

import cv2
import msgspec

import fieldpose

RATE_HZ = 10.0


def main(source: str, camera_file: str, hub: str = "tcp/127.0.0.1:7447") -> int:
    camera = msgspec.json.decode(Path(camera_file).read_bytes(), type=fieldpose.Camera)
    capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        sys.exit(f"{source}: cannot be opened")
    with fieldpose.connect(hub) as pipeline:
        read, bgr = capture.read()
        while read:
            number = pipeline.publish(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), camera)
            print(f"sent frame {number}", flush=True)
            time.sleep(1 / RATE_HZ)
            read, bgr = capture.read()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]) if len(sys.argv) in (3, 4) else __doc__)
