"""Where the benchmarks keep the fields that they train."""

from __future__ import annotations

from pathlib import Path


def kept_field(folder: Path, dataset: Path, size: int, minutes: float) -> Path:
    """The file of a dataset's field in the benchmarks' folder."""
    return folder / f"{dataset.resolve().name}-{size}-{minutes:g}min.safetensors"
