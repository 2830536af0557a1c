"""How much of what is to be seen a field shows: thin parts that vanished cost little PSNR, but poses their hold."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.nerf.datasets import Dataset
from fieldpose.stages.nerf.rendering_api import RayRenderer

NEAR = 0.05
"""How far, as a share, a depth may be from the truth to be of the same part."""


def silhouette_coverage(renderer: RayRenderer, dataset: Dataset) -> float | None:
    """Share of the object's area in all images that the field shows; None if its outline is not known.

    The outline is that of the alpha channel, of which a pixel's opacity covers no more than it has; or of the mask,
    where the depth tells whether the object is seen.
    """
    shown = wanted = 0.0
    for index, record in enumerate(dataset.images):
        known = _outline(dataset, index)
        if known is None:
            return None
        view = renderer.render_view(record.camera.undistorted(), record.cam_from_object)
        outline, depth = known
        there = view.opacity if depth is None else np.abs(view.depth - depth) <= NEAR * depth
        shown += float(np.minimum(there, outline).sum())
        wanted += float(outline.sum())
    return shown / wanted if wanted else None


def _outline(dataset: Dataset, index: int) -> tuple[np.ndarray, np.ndarray | None] | None:
    """The object's share of each pixel (h, w), and true depth where that tells it from what is behind."""
    record = dataset.images[index]
    if dataset.has_alpha:
        return dataset.load_image(index)[..., 3] / 255, None
    if record.mask_path is None or record.depth_path is None:
        return None
    depth = dataset.load_depth(index)
    return dataset.load_mask(index) & (depth > 0), depth
