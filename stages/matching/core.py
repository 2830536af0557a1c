"""Matching a rendered view with a camera image: which pixels of the two show the same point of the surface.

A matcher is a class with the two methods of `Matcher`, and that of `ExtractsAtOnce` if it gains by it. To add one,
write it in a file of this folder beside the others and name it in `MATCHERS`; nothing else in fieldpose needs to know.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from cachetools import LRUCache

from fieldpose.bus.messages import Reason
from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import shrunk_size, unscale_pixels
from fieldpose.stages.geometry.arrays import AnyOpacity, FrameImage, Grey, Image, Mask, Pixels32, Values32
from fieldpose.stages.images import shrunk
from fieldpose.stages.matching.subpixel import align_patches

MATCHERS = {
    "xfeat": "fieldpose.stages.matching.xfeat:XFeatMatcher",
    "xfeat-lighterglue": "fieldpose.stages.matching.lightglue:xfeat_lighterglue",
    "aliked-lightglue": "fieldpose.stages.matching.lightglue:aliked_lightglue",
    "disk-lightglue": "fieldpose.stages.matching.lightglue:disk_lightglue",
    "loftr": "fieldpose.stages.matching.loftr:LoFTRMatcher",
    "sift": "fieldpose.stages.matching.sift:SiftMatcher",
}
"""Name in the configuration -> module and the callable in it that makes a Matcher of a MatchingConfig."""

_KEPT_FRAMES = 2


@dataclass(frozen=True)
class MatchingConfig:
    """Settings of the matching stage."""

    matcher: str = "xfeat"
    """one of: xfeat, xfeat-lighterglue, aliked-lightglue, disk-lightglue, loftr, sift"""
    max_keypoints: int = 2048
    """the strongest keypoints kept in each image"""
    min_confidence: float | None = None
    """matches below it are dropped; None leaves it to the matcher"""
    min_matches: int = 6
    """fewer matches than this are reported as a failure"""
    frame_size: int = 0
    """longer side in pixels to which the frame is shrunk before its features are taken; 0 is the view's own"""
    patch_px: int = 9
    """side of the patches that place coarse matches between pixels; 0 leaves them where the matcher put them"""
    erode_px: int = 0
    """how far inside the silhouette a pixel of the view must lie to be matched"""
    kept_views: int = 16
    """features of so many views are kept, for views that come again"""
    weights: Path | None = None
    """file or folder of network weights, in place of an installed package's"""
    allow_download: bool = False
    """let kornia download weights that are neither given nor installed"""
    device: str = "auto"
    """torch device of the networks; auto: that of the backend"""

    @property
    def torch_device(self) -> str:
        """The device, where it was not left open."""
        return "cpu" if self.device == "auto" else self.device


@dataclass(frozen=True)
class Features:
    """An image to a matcher: its keypoints, its size (width, height), the matcher's own data."""

    pixels: Pixels32
    size: tuple[int, int]
    data: Any


@dataclass(frozen=True)
class MatchedPixels:
    """pixels_a and pixels_b that show the same point; confidence in 0..1."""

    pixels_a: Pixels32
    pixels_b: Pixels32
    confidence: Values32


class Matcher(Protocol):
    """Finds the pixels that two images share; the images may differ in size."""

    placed_between_pixels: bool
    """Whether matches are precise to a fraction of a pixel; if not, they are moved there by their patches."""

    def extract(self, image: Image, mask: Mask | None = None) -> Features:
        """Features of an image, only where mask is true."""
        ...

    def match(self, view: Features, frame: Features) -> MatchedPixels:
        """Matches between two images' features, best first or in any order; none is not an error."""
        ...


@runtime_checkable
class ExtractsAtOnce(Protocol):
    """A matcher that takes the features of several images in less time than one after the other."""

    def extract_all(self, images: Sequence[tuple[Image, Mask | None]]) -> list[Features]:
        """What `extract` gives for images of one size, each with its mask."""
        ...


def build_matcher(config: MatchingConfig) -> Matcher:
    """The matcher that the configuration names, weights read. Raises ConfigError or WeightsError."""
    if config.matcher not in MATCHERS:
        raise ConfigError(f"no matcher {config.matcher!r}; expected one of {', '.join(MATCHERS)}")
    module, name = MATCHERS[config.matcher].split(":")
    matcher: Matcher = getattr(importlib.import_module(module), name)(config)
    return matcher


def visible_mask(opacity: AnyOpacity, erode_px: int) -> Mask:
    """Where a view shows the object, `erode_px` inside its silhouette."""
    half = 127 if opacity.dtype == np.uint8 else 0.5
    visible = (opacity > half).astype(np.uint8)
    eroded = cv2.erode(visible, np.ones((2 * erode_px + 1,) * 2, np.uint8)) if erode_px > 0 else visible
    return eroded.astype(bool)


class PairMatcher:
    """Matches views with frames and keeps the features of the last ones, for views and frames that come again."""

    def __init__(self, matcher: Matcher, config: MatchingConfig, at_once: bool = True) -> None:
        """at_once: two new images in one go, which is faster, and rounds otherwise than one after the other."""
        self._matcher, self._config, self._at_once = matcher, config, at_once
        self._views: LRUCache[Hashable, _Seen] = LRUCache(config.kept_views)
        self._frames: LRUCache[Hashable, _Seen] = LRUCache(_KEPT_FRAMES)

    def match(
        self,
        view_rgb: Image,
        view_opacity: AnyOpacity,
        frame_image: FrameImage,
        view_key: Hashable | None = None,
        frame_key: Hashable | None = None,
    ) -> MatchedPixels | Reason:
        """Match a view and a frame, in their own pixels.

        Only pixels of the view that show the object are matched. Features are kept under the keys, where given.
        TOO_FEW_MATCHES where they are less than the configuration asks for.
        """
        longer_side = self._config.frame_size or max(view_rgb.shape[:2])
        view, frame = self._both(view_rgb, view_opacity, frame_image, longer_side, view_key, frame_key)
        matched = self._matcher.match(view.features, frame.features)
        if len(matched.confidence) < self._config.min_matches:
            return Reason.TOO_FEW_MATCHES
        pixels_b, confidence = matched.pixels_b, matched.confidence
        if self._config.patch_px and not self._matcher.placed_between_pixels:
            window = self._config.patch_px
            pixels_b, factor = align_patches(view.grey, frame.grey, matched.pixels_a, pixels_b, window)
            confidence = confidence * factor
        in_frame = unscale_pixels(pixels_b, frame.scale).astype(np.float32)
        return MatchedPixels(matched.pixels_a, in_frame, confidence)

    def view_features(self, rgb: Image, opacity: AnyOpacity, view_key: Hashable) -> Features:
        """The features of a view; kept for a match, as there."""
        return self._view(rgb, opacity, view_key).features

    def frame_features(self, frame_image: Image, longer_side: int, frame_key: Hashable | None = None) -> Features:
        """The features of a frame, shrunk to `longer_side`; kept for a match at that size."""
        return self._frame(frame_image, longer_side, frame_key).features

    def _both(
        self, rgb: np.ndarray, opacity: np.ndarray, frame_image: np.ndarray, longer_side: int,
        view_key: Hashable | None, frame_key: Hashable | None,
    ) -> tuple[_Seen, _Seen]:  # fmt: skip
        sized_key = _sized(frame_key, longer_side)
        alike = shrunk_size(*_size(frame_image), longer_side) == _size(rgb)
        new = view_key not in self._views and sized_key not in self._frames
        if self._at_once and alike and new and isinstance(self._matcher, ExtractsAtOnce):
            mask, small = visible_mask(opacity, self._config.erode_px), shrunk(frame_image, longer_side)
            in_view, in_frame = self._matcher.extract_all([(rgb, mask), (small, None)])
            view = _kept(self._views, view_key, lambda: _seen(in_view, rgb, rgb))
            return view, _kept(self._frames, sized_key, lambda: _seen(in_frame, small, frame_image))
        return self._view(rgb, opacity, view_key), self._frame(frame_image, longer_side, frame_key)

    def _view(self, rgb: np.ndarray, opacity: np.ndarray, key: Hashable | None) -> _Seen:
        def look() -> _Seen:
            return _seen(self._matcher.extract(rgb, visible_mask(opacity, self._config.erode_px)), rgb, rgb)

        return _kept(self._views, key, look)

    def _frame(self, image: np.ndarray, longer_side: int, key: Hashable | None) -> _Seen:
        def look() -> _Seen:
            small = shrunk(image, longer_side)
            return _seen(self._matcher.extract(small), small, image)

        return _kept(self._frames, _sized(key, longer_side), look)


@dataclass(frozen=True)
class _Seen:
    """An image's features, its grey values as matched, and its (x, y) scale: matched / given."""

    features: Features
    grey: Grey
    scale: np.ndarray


def _size(image: np.ndarray) -> tuple[int, int]:
    """Width and height."""
    return image.shape[1], image.shape[0]


def _seen(features: Features, matched: np.ndarray, given: np.ndarray) -> _Seen:
    return _Seen(features, cv2.cvtColor(matched, cv2.COLOR_RGB2GRAY), np.divide(_size(matched), _size(given)))


def _kept(cache: LRUCache[Hashable, _Seen], key: Hashable | None, look: Callable[[], _Seen]) -> _Seen:
    """What the cache has under a key, put there where it has nothing; nothing is put under None."""
    seen = cache.get(key)
    if seen is None:
        seen = look()
        if key is not None and cache.maxsize > 0:
            cache[key] = seen
    return seen


def _sized(frame_key: Hashable | None, longer_side: int) -> Hashable | None:
    return None if frame_key is None else (frame_key, longer_side)
