"""Open a dataset of whatever kind its folder shows it to be."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fieldpose.errors import DatasetError
from fieldpose.stages.nerf.datasets import blender, bop, colmap, llff, polycam, record3d, seven_scenes, transforms, tum
from fieldpose.stages.nerf.datasets.assemble import Draft, Holdout, Split, assemble, with_cameras
from fieldpose.stages.nerf.datasets.masks import with_masks
from fieldpose.stages.nerf.datasets.records import Dataset, PosedCamera

_UNPACK = "{}: a recording of Record3D that is not unpacked; unpack it as a zip, or export it as EXR + JPG"


def load_dataset(
    path: str | Path,
    split: Split = "train",
    size: int | None = None,
    downscale: int | None = None,
    *,
    holdout: Holdout | None = "auto",
    llff_normalise: bool = True,
    cameras: Sequence[PosedCamera] | None = None,
    cut_out: bool = False,
) -> Dataset:
    """Read a dataset's poses and cameras, and make sure that its files are there; pixels are read later.

    split: "all" keeps both, each image says which it is in. size: the longer side in pixels to shrink images to.
    downscale: shrink by this factor instead; LLFF takes the folder of that factor. holdout, for kinds without
    splits of their own: "odd" or "every8" images (sorted by name) are test, None holds nothing out, "auto" is "odd"
    for transforms.json and "every8" for others. llff_normalise: see llff.read_llff. cameras: of all images,
    both splits, in their order, instead of those that the files tell. cut_out: what masks leave out is not there, as
    what is transparent is not, instead of not known.
    Raises DatasetError, one line that names the file and says how to mend it.
    """
    root = Path(path)
    _check_options(root, size, downscale)
    draft = _read(root, holdout, llff_normalise, downscale, size)
    if draft.kind != "blender":
        draft = with_masks(_home(root), draft)
    dataset = assemble(root, draft if cameras is None else with_cameras(draft, cameras), split, cut_out)
    if size is not None:
        return dataset.resized(size)
    if downscale is not None and dataset.kind != "llff":
        longest = max(max(record.camera.width, record.camera.height) for record in dataset.images)
        return dataset.resized(max(1, round(longest / downscale)))
    return dataset


def _home(root: Path) -> Path:
    """The folder of the dataset that a path means, which may go on to name an object in it."""
    scene = bop.scene_of(root)
    return root if scene is None else scene[0]


def _read(root: Path, holdout: Holdout | None, normalise: bool, downscale: int | None, size: int | None) -> Draft:
    scene, packed = bop.scene_of(root), record3d.packed_in(root)
    if packed is not None and not root.is_dir():
        raise DatasetError(_UNPACK.format(packed))
    if not root.is_dir() and scene is None:
        what = "a file; give the folder that it is in" if root.exists() else "no such folder; give a dataset's folder"
        raise DatasetError(f"{root}: {what}")
    if (root / blender.TRAIN_FILE).is_file():
        return blender.read_blender(root)
    if (root / transforms.FILE).is_file():
        return transforms.read_transforms(root, holdout)
    if (root / llff.FILE).is_file():
        return llff.read_llff(root, holdout, normalise, downscale, size)
    model = colmap.model_of(root)
    if model is not None:
        return colmap.read_colmap(root, model, holdout)
    if seven_scenes.is_seven_scenes(root):
        return seven_scenes.read_seven_scenes(root, holdout)
    if scene is not None:
        return bop.read_bop(*scene, holdout)
    if (root / tum.FILE).is_file():
        return tum.read_tum(root, holdout)
    if polycam.is_polycam(root):
        return polycam.read_polycam(root, holdout)
    metadata = record3d.metadata_of(root)
    if metadata is not None:
        return record3d.read_record3d(root, metadata, holdout)
    if packed is not None:
        raise DatasetError(_UNPACK.format(packed))
    raise DatasetError(
        f"{root}: not a dataset; expected {blender.TRAIN_FILE}, {transforms.FILE}, {llff.FILE}, a COLMAP model"
        f" ({colmap.MODELS[0]}), BOP's {bop.CAMERAS}, TUM's {tum.FILE}, frame-*.pose.txt of 7-Scenes, Polycam's"
        " keyframes or Record3D's metadata.json in it"
    )


def _check_options(root: Path, size: int | None, downscale: int | None) -> None:
    if size is not None and downscale is not None:
        raise DatasetError(f"{root}: give size or downscale, not both (got {size} and {downscale})")
    for name, value in (("size", size), ("downscale", downscale)):
        if value is not None and value < 1:
            raise DatasetError(f"{root}: {name} must be at least 1, got {value}")
