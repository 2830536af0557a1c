"""Where the embedded demo scene is."""

from __future__ import annotations

from pathlib import Path

from fieldpose.errors import FieldposeError

_FOLDER = Path(__file__).resolve().parent.parent / "recordings" / "demo"


def demo_file(name: str) -> Path:
    """A file of the demo scene. Raises FieldposeError where fieldpose was installed without it."""
    path = _FOLDER / name
    if not path.is_file():
        raise FieldposeError(
            f"{path}: no such file; the demo scene is missing from this installation: install fieldpose again"
        )
    return path
