"""From a video or photographs to a dataset that a field can be learnt from."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import tyro

from fieldpose.deploy.capturing import ENOUGH, FEWEST, OBJECT_PICTURE, Captured, Square, advice, capture, summary
from fieldpose.deploy.reporting.output import check_new_folder, check_writable, progress_bar, write_json
from fieldpose.deploy.shots import FILMED_S
from fieldpose.errors import UsageError


@dataclass(frozen=True)
class Options:
    """Find the cameras of a video's frames or of photographs, and write both as a dataset to train on.

    Example: fieldpose capture can.mp4 --out out/can && fieldpose train out/can --out out/can.safetensors

    Walk around the object, slowly and in a good light, so that each part of it is seen from several sides, and leave
    it where it stands. Sharp frames are chosen, evenly along the way that the picture moved; cameras are found by what
    the images share, one lens for all of them; up is that of the plane that the object stands on, the origin is on it
    under what the cameras look at, and the unit, which no image tells, the median distance of the cameras from there;
    with a marker of known size in view (--marker) frame and unit are the marker's.
    The dataset has images/, transforms.json, in which one image in ten is held out, and camera.json, the camera that
    was found, for `run` (--camera.camera-file). What stands apart in the midst of the cameras gets a box, object_aabb
    in transforms.json, which may be edited there; object.jpg shows it. Photographs are turned as their EXIF says.
    Masks of the object, in a folder masks in or beside that of the photographs (white where it is), or an alpha
    channel, keep what is around it out of the search for cameras, as where it was filmed on a turntable. The JSON file
    has: seen, chosen, blurred, images (with a camera), reasons (image -> why it has none), camera, error_px,
    on_plane (whether up is a plane's), metres_per_unit (null: not known), marker (its number, how many images show it),
    object_aabb (null: none was found), notes, seconds.
    """

    source: tyro.conf.Positional[str]
    """A video file, a folder of photographs, or a source as `run` takes it (video:FILE, mcap:FILE, bag:FILE of ROS,
    camera:0)."""
    out: Path
    """The folder to write; it is to be empty or not there."""
    most: int = 150
    """At most so many frames of a video."""
    size: int = 1600
    """Images whose longer side has more pixels are shrunk to it."""
    seconds: float = FILMED_S
    """How long a live camera films; Ctrl-C ends it as well, and what was filmed is used. Meanwhile a picture beside the
    folder (OUT.filming.jpg) shows every three seconds what has been covered."""
    marker: float | None = None
    """Length of a printed marker's side in metres, its black square: with such a marker in view, beside or under the
    object, lengths are in metres, z is out of the marker, x to its right, and the origin in its middle."""
    family: Literal["4x4", "5x5", "6x6", "7x7", "aruco", "tag16h5", "tag25h9", "tag36h11"] = "4x4"
    """Of the marker: ArUco's dictionaries by their bits, ArUco's original one, or AprilTag's families."""
    threads: int = 0
    """0: one for each core."""
    json: Path | None = None
    """Write the figures into this file."""

    def run(self) -> int:
        """Capture, say what was found, and what is next."""
        code = self.capture()
        print(f"next: fieldpose train {self.out} --out {self.out}.safetensors")
        return code

    def capture(self) -> int:
        """Capture, say what was found."""
        if self.most < 2 * FEWEST or self.size < 64 or self.threads < 0:
            raise UsageError(f"--most must be at least {2 * FEWEST}, --size at least 64, and --threads at least 0")
        if not 0 < self.seconds < float("inf"):
            raise UsageError(f"--seconds {self.seconds}: expected more than 0")
        if self.marker is not None and not 0 < self.marker < float("inf"):
            raise UsageError(f"--marker {self.marker}: expected the length of a side in metres")
        check_new_folder(self.out)
        check_writable(self.json)
        began = time.monotonic()
        with progress_bar("capture") as report:
            square = None if self.marker is None else Square(self.family, self.marker)
            captured = capture(self.source, self.out, self.most, self.size, self.threads, report, square, self.seconds)
        seconds = time.monotonic() - began
        write_json(self.json, {**asdict(captured), "seconds": seconds})
        for line in _in_words(captured, self.out, seconds):
            print(line)
        return 0


def _in_words(captured: Captured, out: Path, seconds: float) -> Iterator[str]:
    camera = captured.camera
    blurred = f", {captured.blurred} left out as blurred" if captured.blurred else ""
    lens = f"focal length {camera.fx:.0f} px at {camera.width}x{camera.height}"
    yield (
        f"{out}: {captured.images} of {captured.chosen} images have a camera (of {captured.seen} seen{blurred}), error"
        f" {captured.error_px:.2f} px, {lens}; {seconds:.0f} s"
    )
    if captured.marker is not None:
        number, images = captured.marker
        yield f"frame and metres are those of marker {number}, which {images} images show"
    up = "what the object stands on" if captured.on_plane else "the cameras (no plane was found under the object)"
    if captured.marker is None:
        yield f"up is that of {up}; lengths are in the median distance of the cameras from what they look at"
    if captured.object_aabb is not None:
        yield f"a box was put around the object ({out / OBJECT_PICTURE} shows it); `train --only box` learns it alone"
    if captured.reasons:
        few = captured.images < ENOUGH * captured.chosen
        yield (
            f"{len(captured.reasons)} images have no camera: {summary(captured.reasons)}"
            f"{'; ' + advice(captured.reasons) if few else ''}"
        )
    yield from captured.notes
