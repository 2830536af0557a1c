"""The pose of single images, in this process and without a bus."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np

from fieldpose.bus.messages import CameraOrigin
from fieldpose.deploy.local import PoseFinder as PartsFinder
from fieldpose.deploy.local import PoseFound
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import resolve
from fieldpose.deploy.settings import Settings
from fieldpose.errors import GeometryError
from fieldpose.stages.camera.calibration import Calibrator
from fieldpose.stages.geometry import RIGID_TOLERANCE, Camera, is_rigid
from fieldpose.stages.images import checked_image
from fieldpose.stages.nerf.datasets.images import load_photo
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.training_views import training_views


class PoseFinder:
    """Finds poses in one field, image by image; no image depends on another.

    Loading takes a second or two, the first time on a machine half a minute more, for compiling. `settings`: as in a
    configuration file (`read_settings`), what is left open being decided as `fieldpose estimate` does. Raises
    FieldposeError for a field that cannot be used, a bad setting, or weights that are missing.
    """

    def __init__(self, field: str | Path, settings: Settings | None = None) -> None:
        settings, path = settings or Settings(), Path(field)
        settings = replace(settings, tracking=replace(settings.tracking, sequence="photos"))
        loaded = load_field(path)
        views = training_views(loaded)
        self._parts = Parts(resolve(settings, views, path), together=True)
        self._parts.field = loaded
        self._calibrator = Calibrator(settings.camera, self._parts.known_cameras())
        self._finder = PartsFinder(self._parts)

    def find(
        self, image: np.ndarray | str | Path, camera: Camera | None = None, guess: np.ndarray | None = None
    ) -> PoseFound:
        """The pose of an image, or the reason why there is none.

        image: (h, w, 3) uint8 RGB, or an image file, whose EXIF may tell of its lens and how it is to be turned; with a
        camera it is taken as it is stored. camera: of the image; without it
        the training views' camera where the shape is theirs, else EXIF's focal length, else an assumed field of view,
        by which no pose is sure (`state` is LIMITED and the covariance large). guess: a cam_from_object (4, 4) to begin
        with; without it, the training views that look like the image. Raises FieldposeError for what is no image, or
        no rigid guess.
        """
        if guess is not None and not is_rigid(guess, RIGID_TOLERANCE):
            raise GeometryError(f"a guess must be a rigid (4, 4) cam_from_object, got {np.asarray(guess).tolist()}")
        if not isinstance(image, np.ndarray) and camera is None:
            pixels, calibration = self._calibrator.photo(Path(image))
            return self._finder.find(pixels, calibration.camera, guess, calibration.origin)
        pixels = image if isinstance(image, np.ndarray) else load_photo(Path(image))
        checked_image(pixels)
        if camera is not None:
            return self._finder.find(pixels, camera, guess, CameraOrigin.CALIBRATED)
        calibration = self._calibrator.of(pixels.shape[1], pixels.shape[0])
        return self._finder.find(pixels, calibration.camera, guess, calibration.origin)

    def close(self) -> None:
        """Let go of what is held."""
        self._finder.close()

    def __enter__(self) -> PoseFinder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
