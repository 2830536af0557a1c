"""Settings of the PnP stage."""

from __future__ import annotations

from dataclasses import dataclass

from fieldpose.errors import ConfigError


@dataclass(frozen=True)
class PnpConfig:
    """When a pose counts as found, and how hard it is looked for."""

    threshold_px: float = 3.0
    """largest reprojection error of an inlier where the image is 400 pixels long; it grows with the image"""
    iterations: int = 5000
    """at most so many samples of three points; 1000 where a better pose than one found is looked for"""
    confidence: float = 0.999
    """RANSAC stops when a better pose would have been seen with this probability"""
    least_iterations: int = 50
    """at least so many"""
    min_inliers: int = 8
    """fewer inliers are no pose"""
    min_inlier_ratio: float = 0.08
    """a smaller share of inliers is no pose: that many agree by chance"""
    min_spread: float = 0.01
    """inliers must extend at least this share of the image's longer side across their narrowest direction (std)"""
    max_rotation_std_deg: float = 5.0
    """a pose that its inliers leave less certain than this is none"""
    max_translation_std: float = 0.014
    """nor is one whose translation is less certain than this share of the distance to the inliers"""
    confidence_power: float = 2.0
    """squared errors are weighted by the matches' confidence to this power; 0: all the same"""
    shared_error: float = 0.6
    """how far neighbouring matches err together, as a multiple of the inliers' residuals; found on several scenes"""
    shared_error_by_angle: float = 0.8
    """what is added to it for each radian between the directions of view: what is seen from elsewhere looks different
    in ways that neighbours have in common"""
    align_levels: int = 3
    """points are then looked for in the frame by the patches around them, at so many levels of coarseness, each twice
    as fine as the one before; 0: matched pixels are taken as they are"""
    landmarks: int = 100
    """so many points of the view, at most, are looked for besides the matched ones: those with the most texture"""
    align_half: int = 4
    """a patch has this many samples to either side of its middle"""
    align_steps: int = 8
    """at most so many steps to find a patch"""
    align_similarity: float = 0.75
    """patches that correlate less are not found"""
    align_floor_px: float = 0.02
    """no patch is found more exactly, in pixels of the view; with little texture it is as much less exact, and in the
    direction, as its grey values say"""
    align_px: float = 1.5
    """largest reprojection error of a point that was found, in pixels of the view"""
    align_spread: float = 0.63
    """largest root mean square of the errors of what was found, as a share of align_px: points that are found by
    chance lie anywhere, which makes it 0.71"""
    min_unaligned: float = 0.3
    """least share of matches that agree on a pose which no search in the frame bears out, as where that is blurred"""
    min_support: float = 0.15
    """where a smaller share of the points is found in the frame, the matches that agreed may be wrong: others are
    asked for another pose"""
    min_landmarks: float = 0.08
    """where a smaller share of the landmarks is found in the frame, it bears nothing out: so many are by chance"""
    sure_landmarks: float = 0.3
    """where a smaller share of them is, another pose is looked for, and the one with more points found is it"""
    attempts: int = 3
    """so many poses are looked at, at most"""
    unconfirmed_share: float = 0.5
    """of min_inlier_ratio is enough for a pose that is then confirmed by points found in the frame"""
    seed: int = 0
    """of RANSAC's samples"""

    def __post_init__(self) -> None:
        least = {
            "align_levels": 0, "landmarks": 0, "align_half": 1, "align_steps": 1, "attempts": 1, "iterations": 1,
            "min_inliers": 1,
        }  # fmt: skip
        for name, value in least.items():
            if getattr(self, name) < value:
                raise ConfigError(f"pnp: {name} is {getattr(self, name)}, but must be at least {value}")
        for name in ("min_inlier_ratio", "min_unaligned", "min_support", "min_landmarks", "sure_landmarks"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"pnp: {name} is {getattr(self, name)}, but is a share, from 0 to 1")
