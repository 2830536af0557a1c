"""Readers of posed photographs, of many kinds, behind one load_dataset; and writers of two."""

from fieldpose.errors import DatasetError
from fieldpose.stages.nerf.datasets.bounds import SceneBounds
from fieldpose.stages.nerf.datasets.loader import load_dataset
from fieldpose.stages.nerf.datasets.records import Dataset, ImageRecord, PosedCamera, find_name

__all__ = ["Dataset", "DatasetError", "ImageRecord", "PosedCamera", "SceneBounds", "find_name", "load_dataset"]
