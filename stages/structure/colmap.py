"""COLMAP's bundle adjustment and its models; its conventions stay in here: its first pixel has its centre at 0.5.

Sources: Triggs and others, Bundle adjustment: a modern synthesis (2000); Schönberger and Frahm, Structure-from-motion
revisited (2016). pycolmap is imported where it is used, since nothing else should wait for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np

from fieldpose.errors import GeometryError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.geometry.arrays import Points64
from fieldpose.stages.structure.colmap_files import ModelImage
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.tracks import Tracks

if TYPE_CHECKING:
    import pycolmap

PIXEL_CENTRE = 0.5
_ITERATIONS, _TOLERANCE = 50, 1e-6
"""Of one adjustment, among several: the cost changes by less than a millionth."""
_ALIGNED_WITHIN_SIGMA = 10.0
"""COLMAP first brings the cameras into the priors' frame by those that can be within this of their priors."""
Freedom = Literal["focal alone", "poses", "focal", "distortion"]
"""What of the cameras is adjusted: the focal length alone; their poses, the focal length besides, the distortion
besides."""


@dataclass(frozen=True, eq=False)
class PlacePriors:
    """Where cameras (n, 3) are believed to be, and how far off each coordinate of that is (one sigma)."""

    centres: Points64
    sigma: float


def bundle_adjust(
    given: PosedCameras,
    points: Points64,
    tracks: Tracks,
    freedom: Freedom,
    noise_px: float,
    priors: PlacePriors | None = None,
) -> PosedCameras:
    """The cameras that, with points (one a track) to be moved as well, reproject best; equal cameras stay equal.

    noise_px: how exact observations are (one sigma); residuals longer than that count less and less (Cauchy), priors as
    much as they are exact. Frame and unit are left to drift, to where the priors have them if there are any. Raises
    GeometryError where what was found makes no camera.
    """
    import pycolmap

    # Where steps fail others are tried, and what an adjustment is worth is seen by its result.
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    scene, shared = _scene(given, points, tracks, freedom)
    options, config = _options(freedom, noise_px), pycolmap.BundleAdjustmentConfig()
    for image_id in scene.images:
        config.add_image(image_id)
    if freedom == "focal alone":
        pycolmap.create_default_bundle_adjuster(options, config, scene).solve()
        return PosedCameras(_cameras(scene, shared, given), given.cam_from_object)
    if priors is None:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(options, config, scene).solve()
    else:
        # COLMAP counts residuals in pixels, so that of priors and pixels only the ratio matters.
        sigma = priors.sigma / noise_px
        of_priors = pycolmap.PosePriorBundleAdjustmentOptions()
        of_priors.alignment_ransac.random_seed = 0
        of_priors.alignment_ransac.max_error = _ALIGNED_WITHIN_SIGMA * priors.sigma
        of_priors.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
        places = [_prior(scene, i + 1, centre, sigma) for i, centre in enumerate(priors.centres)]
        pycolmap.create_pose_prior_bundle_adjuster(options, of_priors, config, places, scene).solve()
    poses = [_matrix(scene.image(i + 1).cam_from_world()) for i in range(len(given.cameras))]
    return PosedCameras(_cameras(scene, shared, given), np.stack(poses))


def _cameras(scene: pycolmap.Reconstruction, shared: Mapping[Camera, int], given: PosedCameras) -> tuple[Camera, ...]:
    return tuple(from_colmap(scene.camera(shared[camera]), camera) for camera in given.cameras)


def _options(freedom: Freedom, noise_px: float) -> pycolmap.BundleAdjustmentOptions:
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_rig_from_world = freedom != "focal alone"
    options.refine_focal_length = freedom != "poses"
    options.refine_principal_point = False
    options.refine_extra_params = freedom == "distortion"
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = noise_px
    options.ceres.solver_options.num_threads = 1  # more add up in an order of their own, not the same each time
    options.ceres.solver_options.max_num_iterations = _ITERATIONS
    options.ceres.solver_options.function_tolerance = _TOLERANCE
    return options


def _prior(scene: pycolmap.Reconstruction, image_id: int, centre: np.ndarray, sigma: float) -> pycolmap.PosePrior:
    import pycolmap

    prior = pycolmap.PosePrior()
    prior.pose_prior_id = image_id
    prior.corr_data_id = scene.image(image_id).data_id
    prior.position = centre
    prior.position_covariance = np.eye(3) * sigma**2
    prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    return prior


def to_colmap(camera: Camera, camera_id: int, freedom: Freedom) -> pycolmap.Camera:
    """The camera by the simplest of COLMAP's models that can hold it, and what of its distortion is to be adjusted.

    One focal length serves both axes where they are equal, unless the lens is decentred.
    """
    import pycolmap

    k1, k2, p1, p2, k3 = camera.distortion
    cx, cy = camera.cx + PIXEL_CENTRE, camera.cy + PIXEL_CENTRE
    f, both = [camera.fx], [camera.fx, camera.fy]
    bends = freedom == "distortion"
    if k3 != 0:
        model, params = "FULL_OPENCV", [*both, cx, cy, k1, k2, p1, p2, k3, 0, 0, 0]
    elif camera.fx != camera.fy or p1 != 0 or p2 != 0:
        plain = not camera.is_distorted and not bends
        model, params = ("PINHOLE", [*both, cx, cy]) if plain else ("OPENCV", [*both, cx, cy, k1, k2, p1, p2])
    elif k2 != 0:
        model, params = "RADIAL", [*f, cx, cy, k1, k2]
    elif k1 != 0 or bends:
        model, params = "SIMPLE_RADIAL", [*f, cx, cy, k1]
    else:
        model, params = "SIMPLE_PINHOLE", [*f, cx, cy]
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params, camera_id=camera_id)


def can_bend(camera: Camera) -> bool:
    """Whether its distortion can be adjusted: COLMAP's model with a term of the sixth degree has three more of them."""
    return camera.distortion[4] == 0


def from_colmap(found: pycolmap.Camera, camera: Camera) -> Camera:
    """`camera` with the focal lengths and the distortion that COLMAP has found."""
    extra = [float(found.params[i]) for i in found.extra_params_idxs()]
    k1, k2, p1, p2, _, k3 = (extra + [0.0] * 6)[:6] if len(extra) < 8 else (*extra[:4], 0.0, extra[4])
    fx, fy = float(found.focal_length_x), float(found.focal_length_y)
    return msgspec.structs.replace(camera, fx=fx, fy=fy, distortion=(k1, k2, p1, p2, k3))


def _scene(
    given: PosedCameras, points: Points64, tracks: Tracks, freedom: Freedom
) -> tuple[pycolmap.Reconstruction, dict[Camera, int]]:
    import pycolmap

    scene = pycolmap.Reconstruction()
    shared = {camera: i + 1 for i, camera in enumerate(dict.fromkeys(given.cameras))}
    for camera, camera_id in shared.items():
        scene.add_camera_with_trivial_rig(to_colmap(camera, camera_id, freedom))
    place = np.zeros(len(tracks.image), np.int64)
    for i, camera in enumerate(given.cameras):
        seen = tracks.image == i
        place[seen] = np.arange(seen.sum())
        pixels = tracks.pixels[seen] + PIXEL_CENTRE
        image = pycolmap.Image(name=str(i), keypoints=pixels, camera_id=shared[camera], image_id=i + 1)
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(given.cam_from_object[i, :3]))
    starts = [*np.flatnonzero(np.diff(tracks.track, prepend=-1)).tolist(), len(tracks.track)]
    images, places = (tracks.image + 1).tolist(), place.tolist()
    for number, (first, end) in enumerate(pairwise(starts)):
        elements = [pycolmap.TrackElement(images[k], places[k]) for k in range(first, end)]
        scene.add_point3D(points[number], pycolmap.Track(elements))
    return scene, shared


def _matrix(cam_from_world: pycolmap.Rigid3d) -> np.ndarray:
    return np.concatenate([cam_from_world.matrix(), [[0.0, 0.0, 0.0, 1.0]]])


def model_text(images: Sequence[ModelImage]) -> dict[str, str]:
    """The files of a model without points, name -> content, as COLMAP's text format has them; equal cameras are one.

    GeometryError for a name with a space, at which COLMAP would cut it off.
    """
    spaced = next((image.name for image in images if any(map(str.isspace, image.name))), None)
    if spaced is not None:
        raise GeometryError(f"{spaced!r}: COLMAP's text cannot hold a name with a space; rename the image")
    from scipy.spatial.transform import Rotation

    shared = {camera: i + 1 for i, camera in enumerate(dict.fromkeys(image.camera for image in images))}
    cameras = [f"# cameras: {len(shared)}; number, model, width, height, parameters"]
    for camera, number in shared.items():
        held = to_colmap(camera, number, "poses")
        parameters = " ".join(repr(float(value)) for value in held.params)
        cameras.append(f"{number} {held.model.name} {camera.width} {camera.height} {parameters}")
    posed = [f"# images: {len(images)}; number, qw qx qy qz, tx ty tz of cam_from_world, camera, name; no points"]
    for number, image in enumerate(images, start=1):
        x, y, z, w = Rotation.from_matrix(image.cam_from_world[:3, :3]).as_quat(canonical=True).tolist()
        pose = " ".join(map(repr, (w, x, y, z, *image.cam_from_world[:3, 3].tolist())))
        posed += [f"{number} {pose} {shared[image.camera]} {image.name}", ""]
    named = {"cameras.txt": cameras, "images.txt": posed, "points3D.txt": ["# points: 0"]}
    return {name: "\n".join(lines) + "\n" for name, lines in named.items()}
