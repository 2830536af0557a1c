"""The pose of one image."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from fieldpose.bus.messages import CameraOrigin, TrackingState
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.reporting.output import check_writable, write_bytes, write_json
from fieldpose.deploy.reporting.reasons import reason_in_words
from fieldpose.deploy.settings import Settings
from fieldpose.errors import UsageError
from fieldpose.stages.camera.calibration import Calibration, Calibrator
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.geometry import Camera
from fieldpose.stages.images import shrunk_with_camera
from fieldpose.stages.tracking.scoring import deviations


@dataclass(frozen=True)
class Options:
    """Find the pose of one image, in this process and without a bus.

    Example: fieldpose estimate out/lego.safetensors photo.png --json out/pose.json

    Without a guess it begins with the training view that looks most like the image. Where a guess leads to no pose
    that is believed, training views are tried: those that look like the image, then those nearest to the guess
    (--tracking.searches). Exits with 1 where no pose is found.

    It is found as `fieldpose run` finds that of a photo in a folder. The JSON file has: ok, reason, cam_from_object
    (4x4 by rows, OpenCV axes), covariance (6x6 of the left twist: translation, rotation), score, state (limited: found
    with a camera that was assumed), inliers, correspondences, residual_px, refined, loss_before, loss_after, passes,
    camera, camera_origin (calibrated, training, exif or assumed), seconds, stage_ms.
    """

    field: tyro.conf.Positional[Path]
    """The field (.safetensors) of the object or scene."""
    image: tyro.conf.Positional[Path]
    """The image; one with transparency is laid over white."""
    guess: str | None = None
    """Where to begin: train:NAME (the pose of a training view), or a JSON file {"cam_from_object": 4x4 by rows}."""
    camera_file: Path | None = None
    """File of the camera, JSON or as ROS, OpenCV, Kalibr or COLMAP write it (short for --camera.camera-file); without
    it the camera that the training views were taken with, where the image has its shape, else what the image says of
    its focal length."""
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
        from fieldpose.deploy.parts import Parts

        check_writable(self.json, self.overlay)
        plan = planned(self._settings(), self.field)
        parts = Parts(plan, together=True)
        image, calibration = self._image(parts.known_cameras(), plan.settings.camera)
        finder = PoseFinder(parts)
        began = time.perf_counter()
        found = finder.find(image, calibration.camera, origin=calibration.origin)
        seconds = time.perf_counter() - began
        values = {name: getattr(found, name) for name in ("ok", *(f.name for f in dataclasses.fields(found)))}
        told = {"camera": calibration.camera, "camera_origin": calibration.origin, "seconds": seconds}
        write_json(self.json, {name: _plain(value) for name, value in (values | told).items()})
        if calibration.origin in (CameraOrigin.EXIF, CameraOrigin.ASSUMED):
            print(f"camera: {calibration.told}")
        if found.cam_from_object is None:
            why = "" if found.reason is None else f": {reason_in_words(found.reason)} ({found.reason})"
            print(
                f"no pose after {seconds:.2f} s{why}; does it show what the field was learnt of, by the right camera?"
            )
            return 1
        print(f"cam_from_object (OpenCV axes, {parts.field.metadata.unit}):\n{np.round(found.cam_from_object, 6)}")
        quality = f"{found.inliers} of {found.correspondences} points agree, {found.residual_px:.2f} px"
        print(f"{quality}, {found.passes} passes, {seconds:.2f} s{', refined' if found.refined else ''}")
        if found.covariance is not None:
            sigma, sigma_deg = deviations(found.covariance)
            unsure = ": by an assumed camera, so do not rely on it" if found.state is TrackingState.LIMITED else ""
            print(f"standard deviations {sigma:.3g} and {sigma_deg:.3g} degrees{unsure}")
        if self.overlay is not None:
            from fieldpose.deploy.reporting.overlay import encoded, overlaid

            view = parts.renderer.render_view(calibration.camera.undistorted(), found.cam_from_object)
            write_bytes(self.overlay, encoded(overlaid(image, view), self.overlay))
        return 0

    def _settings(self) -> Settings:
        """The settings with the short flags applied, for a photo."""
        s = self.settings
        camera_file, guess = self.camera_file or s.camera.camera_file, self.guess or s.tracking.guess
        if guess is not None and guess.startswith("perturb:"):
            raise UsageError(f"--guess {guess}: of one image no true pose is known; give train:NAME or a file")
        tracking = replace(s.tracking, guess=guess, sequence="photos")
        return replace(s, camera=replace(s.camera, camera_file=camera_file), tracking=tracking)

    def _image(self, known: Sequence[Camera], config: CameraConfig) -> tuple[np.ndarray, Calibration]:
        """The pixels (h, w, 3) uint8 and the camera. Raises DatasetError and SourceError."""
        image, calibration = Calibrator(config, known).photo(self.image)
        image, camera = shrunk_with_camera(image, calibration.camera, config.size)
        return image, replace(calibration, camera=camera)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value
