"""7-Scenes: frame-000000.color.png beside frame-000000.pose.txt, in one sequence or in seq-01, seq-02 and so on.

Source: Shotton and others, Scene coordinate regression forests for camera relocalization in RGB-D images (2013).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera, inverse
from fieldpose.stages.nerf.datasets.assemble import Draft, Holdout, split_of
from fieldpose.stages.nerf.datasets.frames import find_image, relative_name
from fieldpose.stages.nerf.datasets.intrinsics import fitted
from fieldpose.stages.nerf.datasets.parsing import (
    CAMERA_FILE,
    camera_beside,
    checked_rigid,
    left_out,
    listed,
    numbers,
    read_rows,
)
from fieldpose.stages.nerf.datasets.records import ImageRecord

ASSUMED = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
"""Of the colour images; the dataset has no calibration, evaluations take this one (as Brachmann and Rother, DSAC*)."""
_POSES, _COLOUR, _DEPTH = "frame-*.pose.txt", ".color", ".depth.png"
_SEQUENCES = "seq-*"
_SPLITS: dict[Literal["train", "test"], str] = {"train": "TrainSplit.txt", "test": "TestSplit.txt"}
_NAME = re.compile(r"(?:sequence|seq-)0*(\d+)")


def is_seven_scenes(root: Path) -> bool:
    """Whether a folder is a sequence, or has sequences in it."""
    return any(root.glob(_POSES)) or any(root.glob(f"{_SEQUENCES}/{_POSES}"))


def read_seven_scenes(root: Path, holdout: Holdout | None) -> Draft:
    """All images with a pose, in metres; poses are stored as object_from_cam in OpenCV's camera axes.

    A scene is split by TrainSplit.txt and TestSplit.txt, where it has them; else by holdout ("auto": every eighth).
    The camera is that of camera.json, if that is there, else ASSUMED. Depth is that of another camera, beside this one,
    and not read. Raises DatasetError.
    """
    given = camera_beside(root)
    sequences, notes = _sequences(root)
    found = [(path, split) for folder, split in sequences for path in sorted(folder.glob(_POSES))]
    if not found:
        raise DatasetError(f"{root}: no {_POSES} in the sequences that its splits list; unpack these")
    poses = [(path, split, _matrix(path)) for path, split in found]
    lost = [relative_name(root, path) for path, _, pose in poses if not np.isfinite(pose).all()]
    posed = [(path, split, pose) for path, split, pose in poses if np.isfinite(pose).all()]
    if not posed:
        raise DatasetError(f"{root}: none of its {len(poses)} poses is finite; give another sequence")
    rule: Holdout | None = "every8" if holdout == "auto" else holdout
    records = [
        _record(root, path, pose, split or split_of(i, rule), given or ASSUMED)
        for i, (path, split, pose) in enumerate(posed)
    ]
    notes += left_out(len(poses), lost, "the pose is lost, not finite")
    if given is None:
        notes += (
            f"7-Scenes has no calibration: a focal length of {ASSUMED.fx:g} px at {ASSUMED.width}x{ASSUMED.height} and"
            f" a centred principal point are assumed; a {CAMERA_FILE} in {root} would be taken instead",
        )
    if posed[0][0].with_name(_stem(posed[0][0]) + _DEPTH).exists():
        notes += ("depth is that of a second camera, which is not calibrated to the first, and is not read",)
    return Draft("7scenes", records, metres_per_unit=1.0, unit="m", notes=notes)


def _sequences(root: Path) -> tuple[list[tuple[Path, Literal["train", "test"] | None]], tuple[str, ...]]:
    """The folders to read, and the split of each where the files tell."""
    if any(root.glob(_POSES)):
        return [(root, None)], ()
    there = {int(m[1]): path for path in sorted(root.glob(_SEQUENCES)) if (m := _NAME.fullmatch(path.name))}
    files = {split: root / name for split, name in _SPLITS.items() if (root / name).is_file()}
    if not files:
        return [(path, None) for _, path in sorted(there.items())], ()
    splits: dict[int, Literal["train", "test"]] = {}
    for split, file in files.items():
        for where, words in read_rows(file, 1, "a sequence, like sequence1"):
            named = _NAME.fullmatch(words[0])
            if named is None or len(words) > 1:
                raise DatasetError(f"{where}: {' '.join(words)[:80]!r} is no sequence; expected a line like sequence1")
            number = int(named[1])
            if number not in there:
                raise DatasetError(
                    f"{where}: there is no {root / f'seq-{number:02d}'}; unpack it, or take the line out"
                )
            if splits.get(number, split) != split:
                raise DatasetError(f"{where}: {words[0]} is in both splits; take it out of one")
            splits[number] = split
    unlisted = [path.name for number, path in sorted(there.items()) if number not in splits]
    notes = (f"in no split, and left out: {listed(unlisted)}",) if unlisted else ()
    return [(there[number], split) for number, split in sorted(splits.items())], notes


def _matrix(path: Path) -> np.ndarray:
    """object_from_cam (4, 4), not finite where the camera was lost."""
    rows: Sequence[list[float]] = [numbers(where, words) for where, words in read_rows(path, 4, "4 numbers")]
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise DatasetError(f"{path}: expected 4 rows of 4 numbers, got {[len(r) for r in rows]}; unpack it again")
    return np.array(rows)


def _record(
    root: Path, path: Path, object_from_cam: np.ndarray, split: Literal["train", "test"], camera: Camera
) -> ImageRecord:
    image = find_image(path.parent, _stem(path) + _COLOUR)
    if image is None:
        raise DatasetError(f"{path}: no image {_stem(path)}{_COLOUR}.png beside it; restore it, or remove this pose")
    pose = inverse(checked_rigid(object_from_cam, str(path)))
    return ImageRecord(relative_name(root, image), image, fitted(image, camera), pose, split)


def _stem(pose: Path) -> str:
    return pose.name.removesuffix(".pose.txt")
