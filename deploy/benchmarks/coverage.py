"""How much of what is to be seen a field shows: thin parts that vanished cost little PSNR, but poses their hold."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.nerf.datasets import Dataset
from fieldpose.stages.nerf.rendering_api import RayRenderer

SHOWN, NEAR = 0.5, 0.05
"""Opacity of a pixel that is shown; how far, as a share, a depth may be from the truth to be of the same part."""


def silhouette_coverage(renderer: RayRenderer, dataset: Dataset) -> float | None:
    """Share of the object's pixels in all images in which the field has it; None if its outline is not known.

    The outline is that of the alpha channel, or of the mask; there the depth tells whether the object is seen.
    """
    shown = wanted = 0
    for index, record in enumerate(dataset.images):
        known = _outline(dataset, index)
        if known is None:
            return None
        view = renderer.render_view(record.camera.undistorted(), record.cam_from_object)
        outline, depth = known
        there = view.opacity >= SHOWN
        if depth is not None:
            there &= np.abs(view.depth - depth) <= NEAR * depth
        shown += int((there & outline).sum())
        wanted += int(outline.sum())
    return shown / wanted if wanted else None


def _outline(dataset: Dataset, index: int) -> tuple[np.ndarray, np.ndarray | None] | None:
    """The object's pixels (h, w) bool, and their true depth where that is what tells them from what is behind."""
    record = dataset.images[index]
    if dataset.has_alpha:
        return dataset.load_image(index)[..., 3] > 127, None
    if record.mask_path is None or record.depth_path is None:
        return None
    depth = dataset.load_depth(index)
    return dataset.load_mask(index) & (depth > 0), depth
