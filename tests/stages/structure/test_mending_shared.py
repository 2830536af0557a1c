"""Photographs that lie beside the project: cameras from structure from motion are kept, disturbed ones mended."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.papered_room import disturbed, worst

from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.structure.mending import mend
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.similarity import align

DATA = Path(__file__).parents[3].parent / "shared" / "data"
COUNT = 9


@pytest.mark.skipif(not (DATA / "fox").is_dir(), reason="../shared/data/fox is not there")
def test_fox() -> None:
    dataset = load_dataset(DATA / "fox", "all", size=800)
    records = dataset.images[:COUNT]
    given = PosedCameras(tuple(r.camera for r in records), np.stack([r.cam_from_object for r in records]))
    images = [dataset.load_image(i) for i in range(COUNT)]
    kept = mend(given, lambda index, width, height: images[index], 400, threads=2)
    assert kept.verdict == "fit"
    assert kept.posed is given
    off = disturbed(given, 0.3, 0.02)
    found = mend(off, lambda index, width, height: images[index], 400, threads=2)
    assert found.verdict == "adjusted"
    assert found.posed.cameras == given.cameras
    poses = found.posed.cam_from_object
    there = PosedCameras(given.cameras, align(poses, given.cam_from_object).of_poses(poses))
    turned, moved = worst(there, given)
    assert turned < 0.15
    assert moved < 0.015
