"""Settings of the retrieval stage."""

from __future__ import annotations

from dataclasses import dataclass

from fieldpose.errors import ConfigError

_MOST = 256
"""Candidates that fit into a message."""


@dataclass(frozen=True)
class RetrievalConfig:
    """How training views are compared with frames."""

    candidates: int = 16
    """so many training views are named for a frame, the most alike first; 0 turns retrieval off"""
    keypoints: int = 128
    """strongest keypoints of a frame that are compared"""
    min_cosine: float = 0.7
    """descriptors that are less alike say nothing"""

    def __post_init__(self) -> None:
        for name, least, most in (("candidates", 0, _MOST), ("keypoints", 1, 4096)):
            if not least <= getattr(self, name) <= most:
                raise ConfigError(f"retrieval: {name} is {getattr(self, name)}, but must be {least} to {most}")
