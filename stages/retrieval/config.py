"""Settings of the retrieval stage."""

from __future__ import annotations

from dataclasses import dataclass

from stages.errors import ConfigError


@dataclass(frozen=True)
class RetrievalConfig:
    """How training views are remembered and compared with frames."""

    candidates: int = 16
    """so many training views are named for a frame, the most alike first; 0 turns retrieval off"""
    keypoints: int = 128
    """strongest keypoints of a frame that are compared"""
    size: int = 400
    """longer side in pixels to which images are shrunk"""
    min_cosine: float = 0.7
    """descriptors that are less alike say nothing"""

    def __post_init__(self) -> None:
        least = {"candidates": 0, "keypoints": 1, "size": 32}
        for name, value in least.items():
            if getattr(self, name) < value:
                raise ConfigError(f"retrieval: {name} is {getattr(self, name)}, but must be at least {value}")
