"""Foxglove's SDK, which not every installation has."""

from __future__ import annotations

import importlib.util

from fieldpose.errors import UsageError


def check_extra() -> None:
    """Raise UsageError where the SDK is not installed."""
    if importlib.util.find_spec("foxglove") is None:
        raise UsageError(
            "the package foxglove-sdk is not installed; it comes with the extra: pip install 'fieldpose[foxglove]'"
        )
