"""How fast each matcher is, how much it finds, and how much of that is right."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from fieldpose.bus.messages import Reason
from fieldpose.deploy.benchmarks import machine
from fieldpose.deploy.scene import demo_file
from fieldpose.errors import WeightsError
from fieldpose.stages.geometry import Camera, perturb, points_at_depth
from fieldpose.stages.lifting.core import MAX_DEPTH_STEP, depth_at
from fieldpose.stages.matching.core import MATCHERS, MatchedPixels, Matcher, MatchingConfig, PairMatcher, build_matcher
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.loading import load_renderer
from fieldpose.stages.nerf.rendering_api import RayRenderer, RenderedView

RIGHT_PX = 2.0
_TURN_DEG, _SHIFT = (5.0, 15.0), 0.1


@dataclass(frozen=True)
class Pair:
    """A view, rendered at a guess, and the image (h, w, 3) uint8 that it is matched with, taken at `truth` (4, 4)."""

    view: RenderedView
    image: np.ndarray
    camera: Camera
    truth: np.ndarray


def measure(
    matchers: Sequence[str], sizes: Sequence[int], pairs: int, threads: int, report: Callable[[str], None]
) -> dict[str, Any]:
    """Everything that `fieldpose bench match` prints, as its JSON.

    Matchers are names in MATCHERS, all by default; sizes are the pixels of the longer side of both images; 0
    threads are all cores. Raises ConfigError, and WeightsError where no matcher's weights can be had.
    """
    threads = threads or machine.cores()
    torch.set_num_threads(threads)
    ready, missing = _ready(matchers or tuple(MATCHERS))
    renderer = load_renderer(demo_file("field.safetensors"), machine.cores())
    by_size: dict[str, dict[str, dict[str, float]]] = {}
    for size in sizes:
        drawn, rows = _pairs(renderer, size, pairs), by_size.setdefault(str(size), {})
        for name, matcher in ready.items():
            report(f"{name}, {size} pixels")
            rows[name] = _of(matcher, MatchingConfig(matcher=name), drawn)
    return {
        "machine": machine.describe(),
        "threads": threads,
        "pairs": pairs,
        "right_px": RIGHT_PX,
        "missing": missing,
        "sizes": by_size,
    }


def _ready(names: Iterable[str]) -> tuple[dict[str, Matcher], dict[str, str]]:
    """The matchers whose weights can be had, and why the others' cannot, by name."""
    ready, missing, last = {}, {}, None
    for name in names:
        try:
            ready[name] = build_matcher(MatchingConfig(matcher=name))
        except WeightsError as error:
            missing[name], last = str(error), error
    if last is not None and not ready:
        raise last
    return ready, missing


def _pairs(renderer: RayRenderer, size: int, count: int) -> list[Pair]:
    """Test images of the demo scene, evenly chosen, each with a view from a pose near its own."""
    dataset = load_dataset(demo_file("transforms_test.json").parent, "test", size)
    centre = np.zeros(3) if dataset.object_aabb is None else dataset.object_aabb.mean(axis=0)
    rng, drawn = np.random.default_rng(0), []
    for i in np.linspace(0, len(dataset) - 1, count).round().astype(int):
        record = dataset.images[i]
        guess = perturb(record.cam_from_object, rng, _TURN_DEG, _SHIFT, centre)
        view = renderer.render_view(record.camera.undistorted(), guess)
        drawn.append(Pair(view, dataset.load_rgb(i), record.camera, record.cam_from_object))
    return drawn


def _of(matcher: Matcher, config: MatchingConfig, pairs: list[Pair]) -> dict[str, float]:
    known = PairMatcher(matcher, config)
    # The first inferences are slow, for networks choose their kernels in them: for two images, and for one.
    for frame_key in range(2):
        _matched(known, pairs[0], "first", frame_key)
    both_new = [_timed(PairMatcher(matcher, config), pair) for pair in pairs]
    view_known = []
    for i, pair in enumerate(pairs):
        known.view_features(pair.view.rgb, pair.view.opacity, i)
        view_known.append(_timed(known, pair, i)[1])
    right = np.concatenate([is_right(pair, matched) for pair, (matched, _) in zip(pairs, both_new, strict=True)])
    return {
        "ms_per_pair": 1e3 * float(np.median([seconds for _, seconds in both_new])),
        "ms_view_known": 1e3 * float(np.median(view_known)),
        "matches": len(right) / len(pairs),
        "share_right": float(right.mean()) if len(right) else 0.0,
    }


def _timed(matcher: PairMatcher, pair: Pair, view_key: int | None = None) -> tuple[MatchedPixels, float]:
    began = time.perf_counter()
    matched = _matched(matcher, pair, view_key)
    return matched, time.perf_counter() - began


def _matched(
    matcher: PairMatcher, pair: Pair, view_key: str | int | None = None, frame_key: int | None = None
) -> MatchedPixels:
    matched = matcher.match(pair.view.rgb, pair.view.opacity, pair.image, view_key, frame_key)
    if isinstance(matched, Reason):
        nothing = np.zeros((0, 2), np.float32)
        return MatchedPixels(nothing, nothing, np.zeros(0, np.float32))
    return matched


def is_right(pair: Pair, matched: MatchedPixels) -> np.ndarray:
    """Which matches (n,) bool lie within RIGHT_PX of where the view's depth and the true pose place the point."""
    view = pair.view
    depths = depth_at(view.depth, matched.pixels_a, MAX_DEPTH_STEP)
    points = points_at_depth(view.camera, view.cam_from_object, matched.pixels_a, depths)
    in_camera = points @ pair.truth[:3, :3].T + pair.truth[:3, 3]
    seen = (depths > 0) & (in_camera[:, 2] > 0)
    away = np.full(len(seen), np.inf)
    away[seen] = np.linalg.norm(pair.camera.project(in_camera[seen]) - matched.pixels_b[seen], axis=1)
    right: np.ndarray = away < RIGHT_PX
    return right
