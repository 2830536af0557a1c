"""What readers share: text, JSON and numbers from files, rotations from quaternions, and the errors that name them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from fieldpose.errors import DatasetError, SourceError
from fieldpose.stages.geometry import RIGID_TOLERANCE, Camera, is_rigid, nearest_rigid
from fieldpose.stages.geometry.rigid import from_rotation

LFS_POINTER = "version https://git-lfs"
CAMERA_FILE = "camera.json"
"""A calibration beside images of kinds that ship none."""
_QUATERNION_TOLERANCE = 0.01
_AGAIN = "export the dataset again"
_FEW = 3
_LARGEST = 1e15
"""Of a pose: no scene has larger numbers, whose products would overflow."""
_T = TypeVar("_T")


def read_text(file: Path) -> str:
    """The text of a file, without a byte order mark. Raises DatasetError."""
    try:
        text = file.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise DatasetError(f"{file}: no such file") from error
    except (OSError, ValueError) as error:
        raise DatasetError(f"{file}: not readable as text ({error}); {_AGAIN}") from error
    if text.startswith(LFS_POINTER):
        raise DatasetError(f"{file}: a pointer of Git LFS instead of the file itself; fetch it by `git lfs pull`")
    return text


def parse_json(file: Path) -> Any:
    """What a JSON file holds. Raises DatasetError."""
    try:
        return json.loads(read_text(file))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{file}: not valid JSON ({error}); {_AGAIN}") from error


def converted(file: Path, content: object, kind: type[_T]) -> _T:
    """What a JSON file holds as `kind`. Raises DatasetError where it is none."""
    try:
        return msgspec.convert(content, kind)
    except (ValueError, OverflowError, RecursionError) as error:
        raise DatasetError(f"{file}: not as expected ({error}); {_AGAIN}") from error


def read_json(file: Path, kind: type[_T]) -> _T:
    """A JSON file as `kind`. Raises DatasetError."""
    return converted(file, parse_json(file), kind)


def read_rows(file: Path, least: int, expected: str) -> Iterator[tuple[str, list[str]]]:
    """Where each row of a text file is, for messages, and its words; lines that are empty or begin with # are none.

    Raises DatasetError for rows of fewer than `least` words, or for a file without any.
    """
    rows = 0
    for number, line in enumerate(read_text(file).splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{file}: line {number}"
        if len(words) < least:
            raise DatasetError(f"{where}: expected {expected}, got {line.strip()[:80]!r}; {_AGAIN}")
        rows += 1
        yield where, words
    if rows == 0:
        raise DatasetError(f"{file}: it is empty; expected lines of {expected}")


def numbers(where: str, words: Sequence[str]) -> list[float]:
    """Words as numbers, NaN and infinity among them. Raises DatasetError."""
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise DatasetError(f"{where}: {error}; {_AGAIN}") from error


def matrix(where: str, name: str, values: Sequence[float] | None, rows: int, columns: int) -> np.ndarray:
    """(rows, columns) float64 of as many finite numbers, row by row. Raises DatasetError."""
    count = rows * columns
    if values is None or len(values) != count or not np.isfinite(values).all():
        raise DatasetError(f"{where}: {name} must be {count} finite numbers, got {values}; {_AGAIN}")
    return np.array(values, dtype=np.float64).reshape(rows, columns)


def checked_rigid(object_from_cam: np.ndarray, where: str) -> np.ndarray:
    """The rigid transform that a stored matrix is, its rounding removed. DatasetError if it is not nearly one."""
    _check_finite(where, object_from_cam)
    if not is_rigid(object_from_cam, RIGID_TOLERANCE):
        scale = np.linalg.norm(object_from_cam[:3, :3], axis=0)
        determinant = np.linalg.det(object_from_cam[:3, :3])
        raise DatasetError(
            f"{where}: the pose is not rigid (column lengths {np.round(scale, 4).tolist()}, determinant"
            f" {determinant:.4g}, last row {object_from_cam[3].tolist()}); export rigid poses"
        )
    return nearest_rigid(object_from_cam)


def posed_by_quaternion(where: str, xyzw: Sequence[float], position: Sequence[float]) -> np.ndarray:
    """(4, 4) of a quaternion (x, y, z, w) and a position (x, y, z).

    DatasetError unless all is finite and the quaternion of unit length, as nearly as rounding leaves it.
    """
    from scipy.spatial.transform import Rotation

    _check_finite(where, [*xyzw, *position])
    length = float(np.linalg.norm(xyzw))
    if abs(length - 1) > _QUATERNION_TOLERANCE:
        raise DatasetError(f"{where}: the quaternion has length {length:.4g}, not 1; export rigid poses")
    return from_rotation(Rotation.from_quat(np.array(xyzw, dtype=np.float64)), position)


def _check_finite(where: str, pose: ArrayLike) -> None:
    if not (np.abs(pose) <= _LARGEST).all():
        raise DatasetError(
            f"{where}: the pose has a number that is not finite, or beyond {_LARGEST:g}; take the image out or pose it"
            " again"
        )


def camera_beside(root: Path) -> Camera | None:
    """The camera in a dataset's camera.json; None if there is no such file. Raises DatasetError."""
    from fieldpose.stages.camera.camera_files import read_camera_file

    if not (root / CAMERA_FILE).is_file():
        return None
    try:
        return read_camera_file(root / CAMERA_FILE)
    except SourceError as error:
        raise DatasetError(str(error)) from error


def listed(names: Sequence[str]) -> str:
    """The first of some names, and how many more there are."""
    more = f" and {len(names) - _FEW} more" if len(names) > _FEW else ""
    return ", ".join(names[:_FEW]) + more


def left_out(count: int, names: Sequence[str], why: str) -> tuple[str, ...]:
    """The note on those images, of `count`, that are left out; none where there are none."""
    if not names:
        return ()
    verb = "is" if len(names) == 1 else "are"
    return (f"{len(names)} of {count} images {verb} left out ({why}): {listed(names)}",)
