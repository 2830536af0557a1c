"""NeRF-synthetic and scenes like it: transforms_train.json and transforms_test.json, Blender (OpenGL) axes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from fieldpose.stages.nerf.datasets.assemble import Draft
from fieldpose.stages.nerf.datasets.frames import check_distinct, read_document, read_records

TRAIN_FILE, TEST_FILE = "transforms_train.json", "transforms_test.json"


def read_blender(root: Path) -> Draft:
    """Both splits. Where cx and cy are given, (0, 0) is the centre of the top-left pixel.

    Raises DatasetError as frames.read_records does.
    """
    splits: tuple[tuple[Literal["train", "test"], Path], ...]
    splits = (("train", root / TRAIN_FILE), ("test", root / TEST_FILE))
    documents = {split: read_document(file) for split, file in splits if split == "train" or file.exists()}
    records = [
        record
        for split, file in splits
        if split in documents
        for record in read_records(file, documents[split], split, pixel_centre=0.0)
    ]
    check_distinct(f"{root / TRAIN_FILE} and {TEST_FILE}", records)
    train = documents["train"]
    return Draft("blender", records, train.aabb, train.object_aabb, train.metres_per_unit)
