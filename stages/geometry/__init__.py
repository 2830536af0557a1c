"""Cameras, rigid transforms, pose errors, limits and random poses: what every stage shares."""

from fieldpose.stages.geometry.cameras import (
    Camera,
    points_at_depth,
    rays,
    scale_pixels,
    shrunk_size,
    unscale_pixels,
)
from fieldpose.stages.geometry.errors import mahalanobis_squared, rotation_error_deg, translation_error, viewing_angles
from fieldpose.stages.geometry.jacobians import image_jacobian, twist_gradient
from fieldpose.stages.geometry.limits import Limit, pairwise
from fieldpose.stages.geometry.rigid import (
    RIGID_TOLERANCE,
    adjoint,
    camera_centre,
    camera_centres,
    exp_se3,
    interpolate,
    inverse,
    is_rigid,
    log_se3,
    look_at,
    nearest_point_to_axes,
    nearest_rigid,
    rotation_about,
)
from fieldpose.stages.geometry.sampling import perturb
from fieldpose.stages.geometry.similarity import Similarity
from fieldpose.stages.geometry.uncertainty import twist_covariance

__all__ = [
    "RIGID_TOLERANCE",
    "Camera",
    "Limit",
    "Similarity",
    "adjoint",
    "camera_centre",
    "camera_centres",
    "exp_se3",
    "image_jacobian",
    "interpolate",
    "inverse",
    "is_rigid",
    "log_se3",
    "look_at",
    "mahalanobis_squared",
    "nearest_point_to_axes",
    "nearest_rigid",
    "pairwise",
    "perturb",
    "points_at_depth",
    "rays",
    "rotation_about",
    "rotation_error_deg",
    "scale_pixels",
    "shrunk_size",
    "translation_error",
    "twist_covariance",
    "twist_gradient",
    "unscale_pixels",
    "viewing_angles",
]
