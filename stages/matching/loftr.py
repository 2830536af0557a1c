"""LoFTR, the detector-free matcher that the paper uses.

Source: Sun et al., LoFTR: Detector-Free Local Feature Matching with Transformers (CVPR 2021). The network is
kornia's.
"""

from __future__ import annotations

import copy
from typing import Any

import cv2
import numpy as np
import torch
from kornia.core.download import hf_url
from kornia.feature import LoFTR
from kornia.feature.loftr.loftr import default_cfg

from fieldpose.stages.matching.core import Features, MatchedPixels, MatchingConfig
from fieldpose.stages.matching.weights import WeightsFile, find_weights, load_network

WEIGHTS = WeightsFile("loftr_outdoor.ckpt", None, "", (hf_url("loftr", "loftr_outdoor.ckpt"),))
_PIXEL_CENTRE = 0.5
"""The network puts the centre of a pixel at half a pixel from its corner."""


class LoFTRMatcher:
    """LoFTR with the outdoor weights; `data` holds the backbone's feature maps and the mask."""

    placed_between_pixels = True

    def __init__(self, config: MatchingConfig) -> None:
        path = find_weights(WEIGHTS, config.weights, config.allow_download)
        settings: Any = copy.deepcopy(default_cfg)
        if config.min_confidence is not None:
            settings["match_coarse"]["thr"] = config.min_confidence
        self._network: Any = load_network(LoFTR(None, settings), path, config.torch_device, _name_in_network)
        self._device = config.torch_device

    @torch.inference_mode()
    def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
        """Feature maps of an image (h, w, 3) uint8; matches outside mask (h, w) bool are dropped by match()."""
        grey = torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).to(self._device)
        maps = self._network.extract_features(grey[None, None].float() / 255)
        return Features(np.zeros((0, 2), np.float32), (image.shape[1], image.shape[0]), (maps, mask))

    @torch.inference_mode()
    def match(self, view: Features, frame: Features) -> MatchedPixels:
        """Matches of the coarse level, refined in the frame."""
        (view_maps, view_mask), (frame_maps, frame_mask) = view.data, frame.data
        found = self._network({"features0": view_maps, "features1": frame_maps})
        in_view = found["keypoints0"].cpu().numpy().astype(np.float32) - _PIXEL_CENTRE
        in_frame = found["keypoints1"].cpu().numpy().astype(np.float32) - _PIXEL_CENTRE
        confidence = found["confidence"].cpu().numpy().astype(np.float32)
        good = _inside(in_view, view.size, view_mask) & _inside(in_frame, frame.size, frame_mask)
        return MatchedPixels(in_view[good], in_frame[good], np.clip(confidence[good], 0, 1))


def _name_in_network(name: str) -> str:
    return name.removeprefix("matcher.")


def _inside(pixels: np.ndarray, size: tuple[int, int], mask: np.ndarray | None) -> np.ndarray:
    """Which pixels (n, 2) lie in an image of size (width, height), and where its mask is true."""
    nearest = np.rint(pixels).astype(int)
    inside = ((nearest >= 0) & (nearest < size)).all(axis=1)
    if mask is not None:
        clipped = np.clip(nearest, 0, np.array(size) - 1)
        inside &= mask[clipped[:, 1], clipped[:, 0]]
    return inside
