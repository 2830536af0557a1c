"""The ways to find a pose that are compared, each a change of the settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from deploy.settings import Settings

Change = Callable[[Settings], Settings]


def _one_step(settings: Settings) -> Settings:
    return _passes(replace(settings, tracking=replace(settings.tracking, passes=1)))


def _passes(settings: Settings) -> Settings:
    return replace(settings, refinement=replace(settings.refinement, steps=0))


def _unmined(settings: Settings) -> Settings:
    return _one_step(replace(settings, lifting=replace(settings.lifting, views=0)))


def _anywhere(settings: Settings) -> Settings:
    return replace(settings, refinement=replace(settings.refinement, region="image"))


METHODS: dict[str, Change] = {
    "one-step": _one_step,
    "one-step-unmined": _unmined,
    "passes": _passes,
    "full": lambda settings: settings,
    "full-anywhere": _anywhere,
}
"""one-step: a single pass; one-step-unmined: without discarding inconsistent points; passes: as many as
tracking.passes says; full: those and refinement; full-anywhere: refinement on pixels of the whole image."""
