"""Where the layout is that shows everything which is written and served."""

from __future__ import annotations

from pathlib import Path

LAYOUT = Path(__file__).parent / "layout.json"
"""For Foxglove and Lichtblick, which import it."""
