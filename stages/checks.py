"""Checks that settings of several stages have in common."""

from __future__ import annotations

from collections.abc import Mapping

from fieldpose.errors import ConfigError


def refuse_below(stage: str, config: object, least: Mapping[str, float]) -> None:
    """Raise ConfigError where a setting, by name, is less than it must be at least; NaN is less than anything."""
    for name, value in least.items():
        if not getattr(config, name) >= value:
            raise ConfigError(f"{stage}: {name} is {getattr(config, name)}, but must be at least {value:g}")
