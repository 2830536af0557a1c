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
    min_inliers: int = 8
    """fewer inliers are no pose"""
    min_inlier_ratio: float = 0.08
    """a smaller share of inliers is no pose: that many agree by chance"""
    max_rotation_std_deg: float = 5.0
    """a pose that its inliers leave less certain than this is none"""
    max_translation_std: float = 0.014
    """nor is one whose translation is less certain than this share of the distance to the inliers"""
    align_levels: int = 3
    """points are then looked for in the frame by the patches around them, at so many levels of coarseness, each twice
    as fine as the one before; 0: matched pixels are taken as they are"""
    landmarks: int = 100
    """so many points of the view, at most, are looked for besides the matched ones: those with the most texture"""
    seed: int = 0
    """of RANSAC's samples"""

    def __post_init__(self) -> None:
        for name, value in {"align_levels": 0, "landmarks": 0, "iterations": 1, "min_inliers": 1}.items():
            if getattr(self, name) < value:
                raise ConfigError(f"pnp: {name} is {getattr(self, name)}, but must be at least {value}")
        if not 0 <= self.min_inlier_ratio <= 1:
            raise ConfigError(f"pnp: min_inlier_ratio is {self.min_inlier_ratio}, but is a share, from 0 to 1")
