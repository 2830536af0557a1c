"""What is to be run: settings in which nothing is left open any more, and how each was decided."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from fieldpose.deploy.settings import Settings
from fieldpose.errors import ConfigError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.sources import is_video, knows_truth
from fieldpose.stages.following.config import FollowingConfig
from fieldpose.stages.geometry import Similarity
from fieldpose.stages.nerf.backend import resolved
from fieldpose.stages.nerf.config import Backend
from fieldpose.stages.nerf.field import load_metadata
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.refinement.config import RefinementConfig
from fieldpose.stages.rendering.config import RenderingConfig
from fieldpose.stages.tracking.beginning import Beginning, absolute, beginning

VIDEO_VIEW_SIZE, PHOTO_VIEW_SIZE = 256, 400
"""On lego a view of 256 pixels takes half the time of one of 400, and one step from it errs nearly twice as much."""
VIDEO_REUSE_DEG = 5.0

Sequence = Literal["video", "photos"]


@dataclass(frozen=True)
class Plan:
    """A pipeline to be run: its field, and settings with nothing left open but the pace of a source that is elsewhere.

    looks: whether retrieval can be asked. follows: whether every frame is followed. notes: what was decided, and why,
    by name. given: the settings before anything was decided.
    """

    settings: Settings
    field: Path | None = None
    looks: bool = True
    follows: bool = False
    begins: Beginning = dataclasses.field(default_factory=Beginning)
    notes: dict[str, str] = dataclasses.field(default_factory=dict)
    given: Settings = dataclasses.field(default_factory=Settings)

    @property
    def independent(self) -> bool:
        """Whether frames stand each by itself: photos, and frames with guesses of their own."""
        return self.settings.tracking.sequence == "photos" or self.begins.by_frame

    @property
    def in_flight(self) -> int:
        """How many frames are solved at once: one in lockstep, and where all are followed, whatever the depth is."""
        return 1 if self.follows or self.settings.camera.pace == "lockstep" else self.settings.tracking.depth

    def object_from_dataset(self) -> Similarity:
        """From the frame of true poses, the dataset's, into the field's. Raises FieldFileError."""
        if self.field is None:
            return Similarity.identity()
        return load_metadata(self.field).frame.object_from_dataset


def resolve(settings: Settings, views: TrainingViews | None, field: Path | None = None) -> Plan:
    """Decide what the settings leave open, for their source and for a field with these training views.

    A resolved plan's settings give the same plan again. views: None for a process that has no field. Raises
    ConfigError, SourceError and DatasetError.
    """
    notes: dict[str, str] = {}
    sequence = _sequence(settings, notes)
    begins = beginning(settings.tracking.guess, views)
    if begins.disturbance is not None and settings.camera.source and not knows_truth(settings.camera.source):
        raise ConfigError(
            f"guess {settings.tracking.guess}: is made from true poses, which {settings.camera.source} does not know"
        )
    looks = _looks(settings, views, begins, notes)
    camera = _camera(settings.camera, notes)
    follows = _follows(settings.following, sequence, begins, camera, notes)
    backend = _backend(settings.backend, follows, notes)
    resolved_settings = replace(
        settings,
        backend=backend,
        camera=camera,
        following=replace(settings.following, when="always" if follows else "never"),
        tracking=replace(settings.tracking, sequence=sequence, guess=absolute(settings.tracking.guess)),
        rendering=_rendering(settings.rendering, sequence, sequence == "photos" or begins.by_frame, follows, notes),
        matching=replace(settings.matching, device=_device(settings.matching.device, backend)),
        refinement=_refinement(settings.refinement, sequence, notes),
    )
    return Plan(resolved_settings, field, looks, follows, begins, notes, settings)


def _sequence(settings: Settings, notes: dict[str, str]) -> Sequence:
    wanted, source = settings.tracking.sequence, settings.camera.source
    if wanted != "auto":
        notes["sequence"] = wanted
        return wanted
    video = not source or is_video(source)
    notes["sequence"] = f"{'video' if video else 'photos'} (auto: {f'source {source}' if source else 'no source here'})"
    return "video" if video else "photos"


def _looks(settings: Settings, views: TrainingViews | None, begins: Beginning, notes: dict[str, str]) -> bool:
    remembers = views is None or views.descriptors is not None
    if not remembers:
        notes["retrieval"] = "off: the field does not know how its training views look; train it again"
    else:
        notes["retrieval"] = "on" if settings.retrieval.candidates > 0 else "off: --retrieval.candidates 0"
    start = settings.tracking.guess or "training views"
    notes["guess"] = f"{start}{', each frame its own' if begins.by_frame else ''}"
    return remembers and settings.retrieval.candidates > 0


def _camera(config: CameraConfig, notes: dict[str, str]) -> CameraConfig:
    if config.pace == "auto" and config.source:
        pace: Literal["live", "lockstep"] = "live" if is_video(config.source) else "lockstep"
        notes["pace"] = f"{pace} (auto)"
        return replace(config, pace=pace)
    notes["pace"] = config.pace
    return config


def _follows(
    config: FollowingConfig, sequence: Sequence, begins: Beginning, camera: CameraConfig, notes: dict[str, str]
) -> bool:
    """Following is for time that is short; a source that waits for answers has each frame solved, unless asked."""
    if sequence == "photos" or begins.by_frame:
        why = "photos" if sequence == "photos" else "each frame has a guess of its own"
        if config.when == "always":
            raise ConfigError(f"following: always, but these are not frames of a video to follow: {why}")
    elif config.when == "auto":
        why = "" if camera.pace != "lockstep" else "lockstep: each frame is solved"
    else:
        why = "" if config.when == "always" else "never"
    notes["following"] = f"off ({why})" if why else "every frame, solving beside it"
    return not why


def _rendering(
    config: RenderingConfig, sequence: Sequence, independent: bool, follows: bool, notes: dict[str, str]
) -> RenderingConfig:
    size, angle_deg = config.size, config.reuse_angle_deg
    why_size = why_angle = ""
    if size == 0:
        size, why_size = VIDEO_VIEW_SIZE if sequence == "video" else PHOTO_VIEW_SIZE, f" (auto: {sequence})"
    if angle_deg is None:
        angle_deg = 0.0 if independent or follows else VIDEO_REUSE_DEG
        why = "following remembers them" if follows else "frames stand each by itself" if independent else sequence
        why_angle = f" (auto: {why})"
    notes["view size"] = f"{size}{why_size}"
    told = f"within {angle_deg:g} degrees" if angle_deg > 0 else "at the very same pose alone"
    notes["views used again"] = f"{told}{why_angle}"
    return replace(config, size=size, reuse_angle_deg=angle_deg)


def _refinement(config: RefinementConfig, sequence: Sequence, notes: dict[str, str]) -> RefinementConfig:
    if config.when != "auto":
        notes["refinement"] = config.when
        return config
    when: Literal["always", "never"] = "never" if sequence == "video" else "always"
    notes["refinement"] = f"{when} (auto: {sequence})"
    return replace(config, when=when)


def _backend(wanted: Backend, follows: bool, notes: dict[str, str]) -> Backend:
    backend = resolved(wanted)
    notes["backend"] = f"{backend}{' (auto)' if wanted == 'auto' else ''}"
    if wanted == "auto" and follows and backend == "cuda":
        # On an H200 torch takes a second for a view of 256 pixels, its processor's kernels 18 ms.
        notes["backend"] = "numba (auto: single views are sooner there than on the CUDA device)"
        return "numba"
    return backend


def _device(device: str, backend: str) -> str:
    if device != "auto":
        return device
    return "cuda" if backend == "cuda" else "cpu"
