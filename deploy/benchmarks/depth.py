"""How right the rendered depth is, where a dataset knows it."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.nerf.datasets import Dataset
from fieldpose.stages.nerf.rendering_api import RayRenderer


def depth_error(renderer: RayRenderer, dataset: Dataset) -> dict[str, float] | None:
    """Median and 90 % quantile of the relative error of depth within the object over all images; None without depth.

    Pixels within one of the object's outline are left out: there the true depth is that of either surface.
    """
    errors = []
    for index, record in enumerate(dataset.images):
        if record.depth_path is None or record.mask_path is None:
            return None
        view = renderer.render_view(record.camera.undistorted(), record.cam_from_object)
        truth = dataset.load_depth(index)
        inside = _eroded(dataset.load_mask(index)) & (truth > 0)
        errors.append(np.abs(view.depth - truth)[inside] / truth[inside])
    together = np.concatenate(errors)
    return {"median": float(np.median(together)), "p90": float(np.quantile(together, 0.9))}


def _eroded(mask: np.ndarray) -> np.ndarray:
    inner = np.zeros_like(mask)
    inner[1:-1, 1:-1] = mask[1:-1, 1:-1] & mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
    return inner
