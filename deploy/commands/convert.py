"""From a dataset of one kind to one of another, for other programs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from fieldpose.deploy.reporting.output import check_new_folder

if TYPE_CHECKING:
    from fieldpose.stages.nerf.datasets import Dataset
    from fieldpose.stages.nerf.datasets.converting import Converted


@dataclass(frozen=True)
class Options:
    """Write posed photographs of any kind that `train` reads as transforms.json or as a COLMAP model.

    Example: fieldpose convert scans/desk out/desk --to colmap

    transforms is transforms.json, which nerfstudio, instant-ngp and fieldpose read: splits, depths, masks, boxes and
    metres are kept. colmap is a model in text (sparse/0) without points; masks, if there are any, are named as COLMAP
    has them. Images are copied as they are; frame and unit are those of the dataset's own files. The folder is whole in
    the end or not there.
    """

    dataset: tyro.conf.Positional[Path]
    """The folder of the dataset."""
    out: tyro.conf.Positional[Path]
    """The folder to write; it is to be empty or not there."""
    to: Literal["transforms", "colmap"]
    """What to write."""
    images: bool = True
    """Copy the photographs; without them, cameras, depths and masks alone are written."""
    holdout: Literal["auto", "odd", "every8", "none"] = "auto"
    """Which images of a dataset without splits of its own are held out, as `train` has it; for transforms alone."""

    def run(self) -> int:
        """Convert, say what was written and what could not be."""
        from fieldpose.stages.nerf.datasets import load_dataset
        from fieldpose.stages.nerf.datasets.converting import convert

        check_new_folder(self.out)
        holdout = None if self.holdout == "none" else self.holdout
        dataset = load_dataset(self.dataset, "all", holdout=holdout, llff_normalise=False)
        converted = convert(dataset, self.out, self.to, self.images)
        for line in self._in_words(dataset, converted):
            print(line)
        return 0

    def _in_words(self, dataset: Dataset, converted: Converted) -> Iterator[str]:
        from fieldpose.stages.nerf.datasets.converting import IMAGES

        held_out = f", {converted.held_out} of them held out" if converted.held_out else ""
        yield f"{self.out}: {converted.images} images of {self.dataset} ({dataset.kind}){held_out}, as {self.to}"
        if converted.lost:
            yield f"{self.to} has no place for: {', '.join(converted.lost)}"
        if not self.images:
            yield f"put the images into {self.out / IMAGES}"
        yield from dataset.notes
