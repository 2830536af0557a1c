"""A radiance field: its parameters, what is occupied, and its file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from fieldpose.errors import FieldFileError
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.kernels.types import BLOCK, SH_SIZE, Domain, Net
from fieldpose.stages.nerf.metadata import FORMAT_VERSION, FieldMetadata, Space, checked

DESCRIPTOR_SIZE = 64
LEARNT = ("table", "w1", "w2", "c1", "c2", "c3")
_TYPES = {**dict.fromkeys(LEARNT, ("F16", "F32")), "occupied": ("U8",), "descriptors": ("I8",)}
"""What each array of a file may hold."""


@dataclass
class Field:
    """`net` holds the learnt arrays; `occupied` is (n, n, n) bool, indexed [z, y, x] over the unit cube.

    descriptors: (views, keypoints, 64) int8, how the training views look, for retrieval; None if that is not known.
    """

    metadata: FieldMetadata
    net: Net
    occupied: np.ndarray
    descriptors: np.ndarray | None = None

    def domain(self) -> Domain:
        """The domain that the kernels march through."""
        return domain_of(self.metadata.space, self.occupied)

    def save(self, path: Path) -> None:
        """Write a safetensors file; the tables are stored in half precision. The old file stays if this fails."""
        arrays = {name: getattr(self.net, name) for name in LEARNT}
        arrays["table"] = arrays["table"].astype(np.float16)
        arrays["occupied"] = np.packbits(self.occupied.ravel(), bitorder="little")
        if self.descriptors is not None:
            arrays["descriptors"] = self.descriptors
        text = msgspec.json.encode(self.metadata).decode()
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".partial")
        # Not save_file, which lets nobody else read what it writes.
        partial.write_bytes(save(arrays, metadata={"fieldpose": text, "version": str(FORMAT_VERSION)}))
        os.replace(partial, path)


def domain_of(space: Space, occupied: np.ndarray) -> Domain:
    """Pack the occupancy for the kernels."""
    # It brings numba, which no process needs that does not render.
    from fieldpose.stages.nerf.occupancy import pack

    bits, distance = pack(occupied)
    corners = space.corners
    low, high = np.zeros((2, 3), np.float32) if corners is None else corners.astype(np.float32)
    return Domain(
        space.contracted, corners is not None, low, high, space.step, space.near, space.far, bits, distance,
        occupied.shape[0],
    )  # fmt: skip


def grid_layout(config: FieldConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Offsets, resolutions and masks of the levels (int64), and the entries of all tables together."""
    growth = (config.finest_resolution / config.base_resolution) ** (1 / max(config.levels - 1, 1))
    resolutions = np.array([int(config.base_resolution * growth**i + 1e-6) for i in range(config.levels)], np.int64)
    table = 1 << config.log2_table
    dense = (resolutions + 1) ** 3 <= table
    sizes = np.where(dense, (resolutions + 1) ** 3, table)
    offsets = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
    return offsets, resolutions, np.where(dense, -1, table - 1).astype(np.int64), int(sizes.sum())


def new_net(config: FieldConfig, rng: np.random.Generator) -> Net:
    """Random parameters: tables near zero, layers scaled by their width (He et al., 2015)."""
    shapes = learnt_shapes(config)

    def layer(rows: int, columns: int) -> np.ndarray:
        bound = np.sqrt(6 / rows) if columns > 4 else np.sqrt(3 / rows)
        return rng.uniform(-bound, bound, (rows, columns)).astype(np.float32)

    table = rng.uniform(-1e-4, 1e-4, shapes["table"]).astype(np.float32)
    return net_of(config, {"table": table, **{name: layer(*shapes[name]) for name in LEARNT[1:]}})


def learnt_shapes(config: FieldConfig) -> dict[str, tuple[int, int]]:
    """The shape of each learnt array."""
    return {
        "table": (grid_layout(config)[3], config.level_features),
        "w1": (config.levels * config.level_features, config.hidden),
        "w2": (config.hidden, 1 + config.features),
        "c1": (config.features + SH_SIZE, config.colour_hidden),
        "c2": (config.colour_hidden, config.colour_hidden),
        "c3": (config.colour_hidden, 3),
    }


def net_of(config: FieldConfig, learnt: Mapping[str, np.ndarray]) -> Net:
    """Learnt arrays with the layout of their grid."""
    offsets, resolutions, masks, _ = grid_layout(config)
    return Net(**learnt, offsets=offsets, resolutions=resolutions, masks=masks)


def load_field(path: Path) -> Field:
    """Read a field file. Raises FieldFileError, naming the file, for anything that is not one of this version."""
    header, arrays = _read(path)
    metadata = _metadata(path, header)
    try:
        return _assemble(arrays, metadata)
    except KeyError as error:
        raise FieldFileError(f"{path}: damaged field file (array {error} is missing); train it again") from error
    except ValueError as error:
        raise FieldFileError(f"{path}: damaged field file ({error}); train it again") from error


def load_metadata(path: Path) -> FieldMetadata:
    """What a field file says of itself, without its arrays. Raises FieldFileError."""
    return _metadata(path, _read(path, arrays=False)[0])


def _read(path: Path, arrays: bool = True) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    if not path.is_file():
        raise FieldFileError(f"{path}: no such field file; `fieldpose train DATASET --out {path}` makes one")
    try:
        with safe_open(path, framework="numpy") as file:
            # Only those that are known: of other types numpy has none for some.
            names = (_TYPES.keys() & file.keys()) if arrays else ()
            for name in names:
                stored = file.get_slice(name).get_dtype()
                if stored not in _TYPES[name]:
                    raise ValueError(f"array {name} is of {stored}, expected {' or '.join(_TYPES[name])}")
            return file.metadata() or {}, {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError, ValueError, TypeError, OverflowError) as error:
        raise FieldFileError(f"{path}: not a safetensors field file ({error}); train it again") from error


def _metadata(path: Path, header: Mapping[str, str]) -> FieldMetadata:
    if header.get("version") != str(FORMAT_VERSION) or "fieldpose" not in header:
        got = header.get("version", "none")
        raise FieldFileError(
            f"{path}: field format version {got}, this program reads {FORMAT_VERSION}; train the field again"
        )
    try:
        return checked(msgspec.json.decode(header["fieldpose"], type=FieldMetadata))
    except (msgspec.DecodeError, ValueError, OverflowError, RecursionError) as error:
        raise FieldFileError(f"{path}: damaged field file ({error}); train it again") from error


def _assemble(arrays: dict[str, np.ndarray], metadata: FieldMetadata) -> Field:
    shapes = learnt_shapes(metadata.config)
    for name in LEARNT:
        array, expected = arrays[name], shapes[name]
        if array.shape != expected or not np.all(np.isfinite(array)):
            raise ValueError(f"array {name} has shape {array.shape} or values that are not finite, expected {expected}")
    learnt = {name: np.ascontiguousarray(arrays[name], dtype=np.float32) for name in LEARNT}
    bits = np.unpackbits(arrays["occupied"].ravel(), bitorder="little").astype(bool)
    n = round(len(bits) ** (1 / 3))
    if n < BLOCK or n % BLOCK or n**3 != len(bits):
        raise ValueError(f"array occupied has {len(bits)} bits, expected a cube of cells, in blocks of {BLOCK}")
    occupied = bits.reshape(n, n, n)
    return Field(metadata, net_of(metadata.config, learnt), occupied, _descriptors(arrays, len(metadata.cameras)))


def _descriptors(arrays: dict[str, np.ndarray], views: int) -> np.ndarray | None:
    descriptors = arrays.get("descriptors")
    if descriptors is None:
        return None
    if descriptors.dtype != np.int8 or descriptors.ndim != 3 or descriptors.shape[::2] != (views, DESCRIPTOR_SIZE):
        got = f"{descriptors.dtype} of shape {descriptors.shape}"
        raise ValueError(f"array descriptors is {got}, expected int8 of shape ({views}, any, {DESCRIPTOR_SIZE})")
    return descriptors
