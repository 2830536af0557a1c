"""All settings of a pipeline in one tree of frozen dataclasses, and files that change them.

A configuration file is TOML, or JSON where its name ends so, with the names of the tree: `[matching]` and in it
`matcher = "sift"`. What the file does not name keeps its default; flags on the command line win over the file.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import msgspec

from fieldpose.bus.topics import Address
from fieldpose.errors import ConfigError, FieldposeError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.following.config import FollowingConfig
from fieldpose.stages.geometry import Limit
from fieldpose.stages.lifting.config import LiftingConfig
from fieldpose.stages.matching.core import MatchingConfig
from fieldpose.stages.nerf.config import Backend
from fieldpose.stages.pnp.config import PnpConfig
from fieldpose.stages.refinement.config import RefinementConfig
from fieldpose.stages.rendering.config import RenderingConfig
from fieldpose.stages.retrieval.config import RetrievalConfig
from fieldpose.stages.tracking.config import TrackingConfig

T = TypeVar("T")


@dataclass(frozen=True)
class Settings:
    """Every stage's settings; each is described where it is defined."""

    backend: Backend = "auto"
    """What the field is rendered by: compiled kernels on the CPU (numba), torch on a CUDA device (cuda; auto: where
    there is one), or torch on the CPU (torch, slow)."""
    address: Address = field(default_factory=Address)
    camera: CameraConfig = field(default_factory=lambda: CameraConfig(source=""))
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    following: FollowingConfig = field(default_factory=FollowingConfig)
    retrieval: RetrievalConfig = field(default_factory=RetrievalConfig)
    rendering: RenderingConfig = field(default_factory=RenderingConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    lifting: LiftingConfig = field(default_factory=LiftingConfig)
    pnp: PnpConfig = field(default_factory=PnpConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)


def read_settings(path: str | Path | None) -> Settings:
    """The defaults, changed by a file where one is given. Raises ConfigError that names the file and the key."""
    return Settings() if path is None else changed(Settings(), read_file(Path(path)), str(path))


def read_file(path: Path) -> dict[str, Any]:
    """The content of a TOML or JSON file. Raises ConfigError."""
    try:
        text = path.read_text(encoding="utf-8")
        content = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such configuration file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        kind = "JSON" if path.suffix == ".json" else "TOML"
        raise ConfigError(f"{path}: not a {kind} file ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected tables of settings, got a {type(content).__name__}")
    return content


def changed(config: T, changes: dict[str, Any], origin: str, place: str = "") -> T:
    """A dataclass with some of its values replaced, nested tables too.

    Raises ConfigError that names `origin` and the key for an unknown key (with the names that are near it) and for
    a value of the wrong type or out of range.
    """
    hints = get_type_hints(type(config))
    new: dict[str, Any] = {}
    for key, value in changes.items():
        where = f"{place}{key}"
        if key not in hints:
            raise ConfigError(f"{origin}: unknown setting {where!r}; {_suggestion(key, place, list(hints))}")
        old = getattr(config, key)
        if not dataclasses.is_dataclass(old):
            new[key] = _converted(value, hints[key], f"{origin}: {where}")
        elif isinstance(value, dict):
            new[key] = changed(old, value, origin, f"{where}.")
        else:
            raise ConfigError(f"{origin}: {where}: expected a table of settings, got {value!r}")
    try:
        return dataclasses.replace(config, **new)  # type: ignore[type-var]
    except FieldposeError as error:
        raise ConfigError(f"{origin}: {error}") from error


def without_unknown(config: Any, changes: dict[str, Any], place: str = "") -> list[str]:
    """Take what `config` does not have, or has as a table, out of the changes, nested ones too; returns the names.

    A length `x` with its angle `x_deg` becomes the limit that `x` may be in their place.
    """
    for key in [key for key in changes if f"{key}_deg" in changes and isinstance(getattr(config, key, None), Limit)]:
        changes[key] = {"angle_deg": changes.pop(f"{key}_deg"), "distance": changes[key]}
    gone = []
    for key, value in list(changes.items()):
        own = getattr(config, key, None)
        if not hasattr(config, key) or (dataclasses.is_dataclass(own) and not isinstance(value, dict)):
            del changes[key]
            gone.append(f"{place}{key}")
        elif dataclasses.is_dataclass(own):
            gone += without_unknown(own, value, f"{place}{key}.")
    return gone


def overridden(config: T, **values: object) -> T:
    """A dataclass with the values that are given, not None. Raises ConfigError for those out of range."""
    given = {name: value for name, value in values.items() if value is not None}
    return dataclasses.replace(config, **given)  # type: ignore[type-var]


def to_json(settings: Settings) -> bytes:
    """Every setting with its value, as a file that `read_settings` takes."""
    # Python's own JSON has infinity, which some settings may be.
    return json.dumps(msgspec.to_builtins(settings, enc_hook=str), indent=2).encode() + b"\n"


def differing(settings: Settings) -> dict[str, str]:
    """Which settings are not the defaults, by their names on the command line, with their values as text."""

    def told(value: Any) -> str:
        return value if isinstance(value, str) else json.dumps(value)

    defaults, own = (_flat(msgspec.to_builtins(each, enc_hook=str)) for each in (Settings(), settings))
    # A table that may be None has other names in it than None has.
    return {name: told(value) for name, value in own.items() if name not in defaults or defaults[name] != value}


def _flat(table: dict[str, Any], place: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{place}{key.replace('_', '-')}"
        flat |= _flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return flat


def _converted(value: Any, wanted: Any, where: str) -> Any:
    try:
        return msgspec.convert(value, wanted, strict=True, dec_hook=_path)
    except msgspec.ValidationError as error:
        expected = str(error).split(", got")[0].replace("Expected", "expected")
        raise ConfigError(f"{where}: {expected}, got {value!r}") from error


def _path(wanted: type, value: Any) -> Any:
    if wanted is Path and isinstance(value, str):
        return Path(value)
    raise ValueError(f"Expected `{wanted.__name__}`")


def _suggestion(key: str, place: str, names: list[str]) -> str:
    near = difflib.get_close_matches(key, names, n=2, cutoff=0.6)
    known = [f"{place}{name}" for name in near or names]
    return f"did you mean {' or '.join(known)}?" if near else f"there are {', '.join(known)}"
