"""Saving what is in a damaged recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from fieldpose.bus.open_recording import aside_path, unfinished_file
from fieldpose.bus.recovery import recover
from fieldpose.errors import RecordingError


@dataclass(frozen=True)
class Options:
    """Save what can be saved of a recording that was not finished, or is damaged.

    Example: fieldpose recover out/lego.mcap

    An unfinished recording is FILE.mcap.partial; FILE.mcap will do for its name where only that is there. Where
    FILE.mcap.partial.before is beside it, its copying into the other was cut short: then that is what is saved.
    """

    recording: tyro.conf.Positional[Path]
    """The recording (.mcap or .mcap.partial)."""
    out: Path | None = None
    """The whole recording to write (default: FILE.recovered.mcap)."""

    def run(self) -> int:
        """Write the recovered recording."""
        damaged = self._damaged()
        out = self.out or _default_out(damaged)
        if out.exists():
            raise RecordingError(f"{out}: is there already; name another file with --out")
        saved = recover(damaged, out)
        print(f"{out}: {saved} messages saved of {damaged}")
        return 0

    def _damaged(self) -> Path:
        named = self.recording
        if named.suffix == ".partial" and aside_path(named.with_suffix("")).exists():
            return aside_path(named.with_suffix(""))
        return named if named.exists() else unfinished_file(named) or named


def _default_out(damaged: Path) -> Path:
    whole = damaged.with_name(damaged.name.removesuffix(".before").removesuffix(".partial"))
    return whole.with_name(f"{whole.stem}.recovered{whole.suffix}")
