"""The pose of one image."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from fieldpose.deploy.errors import UsageError
from fieldpose.deploy.reporting.output import check_writable, write_bytes, write_json
from fieldpose.deploy.settings import Settings
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.metadata import FieldMetadata

_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Options:
    """Find the pose of one image, in this process and without a bus.

    Example: fieldpose estimate out/lego.safetensors photo.png --json out/pose.json

    Without a guess it begins with the training view that looks most like the image. Where a guess leads to no pose
    that is believed, training views are tried: those that look like the image, then those nearest to the guess
    (--tracking.searches). Exits with 1 where no pose is found.

    The JSON file has: ok, reason, cam_from_object (4x4 by rows, OpenCV axes), covariance (6x6 of the left twist:
    translation, rotation), inliers, correspondences, residual_px, refined, loss_before, loss_after, passes, camera,
    seconds, stage_ms.
    """

    field: tyro.conf.Positional[Path]
    """The field (.safetensors) of the object or scene."""
    image: tyro.conf.Positional[Path]
    """The image; one with transparency is laid over white."""
    guess: str | None = None
    """Where to begin: train:NAME (the pose of a training view), or a JSON file {"cam_from_object": 4x4 by rows}."""
    camera_file: Path | None = None
    """JSON file of the camera (short for --camera.camera-file); without it the camera that the training views were
    taken with, where the image has its shape, else what the image says of its focal length."""
    json: Path | None = None
    """Write the result into this file."""
    overlay: Path | None = None
    """Write a picture of the field rendered over the image into this file (.jpg or .png)."""
    config: Path | None = None
    """TOML or JSON file of settings; flags win over it."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)

    def run(self) -> int:
        """Estimate, print the pose."""
        from fieldpose.deploy.local import PoseFinder
        from fieldpose.stages.nerf.field import load_field
        from fieldpose.stages.nerf.loading import make_renderer
        from fieldpose.stages.tracking.guesses import start_pose
        from fieldpose.stages.tracking.views import training_views

        check_writable(self.json, self.overlay)
        field = load_field(self.field)
        image, camera = self._image(field.metadata)
        views = training_views(field)
        guess = None if self.guess is None else start_pose(self.guess, views)
        if guess is None and views.descriptors is None:
            raise UsageError(
                f"{self.field}: this field does not know how its training views look; give --guess, or train it again"
            )
        if guess is None and self.settings.retrieval.candidates == 0:
            raise UsageError("--retrieval.candidates 0 leaves no pose to begin with; give --guess")
        renderer = make_renderer(field, threads=0)
        finder = PoseFinder(renderer, self.settings, views)
        began = time.perf_counter()
        found = finder.find(image, camera, guess)
        seconds = time.perf_counter() - began
        values = {name: getattr(found, name) for name in ("ok", *(f.name for f in dataclasses.fields(found)))}
        result = {**values, "camera": camera, "seconds": seconds}
        write_json(self.json, {name: _plain(value) for name, value in result.items()})
        if found.cam_from_object is None:
            print(f"no pose: {found.reason} after {seconds:.2f} s")
            return 1
        print(f"cam_from_object (OpenCV axes, {field.metadata.unit}):\n{np.round(found.cam_from_object, 6)}")
        quality = f"{found.inliers} of {found.correspondences} points agree, {found.residual_px:.2f} px"
        print(f"{quality}, {found.passes} passes, {seconds:.2f} s{', refined' if found.refined else ''}")
        if self.overlay is not None:
            from fieldpose.deploy.reporting.overlay import encoded, overlaid

            picture = overlaid(image, renderer.render_view(camera.undistorted(), found.cam_from_object))
            write_bytes(self.overlay, encoded(picture, self.overlay))
        return 0

    def _image(self, metadata: FieldMetadata) -> tuple[np.ndarray, Camera]:
        """The pixels (h, w, 3) uint8 and the camera. Raises DatasetError and SourceError."""
        from fieldpose.stages.camera.calibration import calibrate
        from fieldpose.stages.nerf.datasets.images import load_pixels, over_background, probe

        header = probe(self.image)
        width, height = header.width, header.height
        image = over_background(load_pixels(self.image, width, height, header.has_alpha), "white")
        given = self.camera_file or self.settings.camera.camera_file
        config = replace(self.settings.camera, camera_file=given)
        trained = _training_camera(metadata, width, height) if given is None else None
        return image, trained or calibrate(config, width, height, self.image).camera


def _training_camera(metadata: FieldMetadata, width: int, height: int) -> Camera | None:
    """The first training view's camera at that size, None where the shape is another."""
    for view in metadata.cameras[:1]:
        if abs(view.width * height - view.height * width) <= _ASPECT_TOLERANCE * view.width * height:
            return view.camera.resized(width, height)
    return None


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value
