"""How far a source has been sent, on disk, so that a camera that died goes on instead of beginning again."""

from __future__ import annotations

import json
import os
from pathlib import Path


class Progress:
    """The place of the next frame of one source; nothing is kept where `path` is None."""

    def __init__(self, path: Path | None, source: str) -> None:
        self._path = path
        self._source = source
        self.next = 0 if path is None else self._read(path)

    def advance(self) -> None:
        """One more frame has been sent. Raises OSError where that cannot be noted."""
        self.next += 1
        if self._path is None:
            return
        temporary = self._path.with_name(self._path.name + ".new")
        temporary.write_text(json.dumps({"source": self._source, "next": self.next}), encoding="utf-8")
        os.replace(temporary, self._path)

    def _read(self, path: Path) -> int:
        """The noted place; 0 for another source, and where there is no note that makes sense."""
        try:
            note = json.loads(path.read_text(encoding="utf-8"))
            return max(0, int(note["next"])) if note["source"] == self._source else 0
        except (OSError, ValueError, KeyError, TypeError):
            return 0
