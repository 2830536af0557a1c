"""Another frame and unit for a field that is learnt."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import tyro

from fieldpose.deploy.framing import Framing
from fieldpose.deploy.reporting.fields import frame_in_words
from fieldpose.deploy.reporting.output import check_writable, progress_console, write_bytes, write_json
from fieldpose.errors import OutputError, UsageError
from fieldpose.stages.cores import usable_cores


@dataclass(frozen=True)
class Options:
    """Turn, move and scale a field's frame of reference, in which poses are found, without learning it anew.

    Example: fieldpose frame out/can.safetensors --known-distance 0012.jpg:201,140 0012.jpg:203,262 0.115

    First --up, then --origin, then the scale; points, directions and pixels are those of the field as it was before. A
    point is X,Y,Z, or IMAGE:X,Y: what a training view shows at a pixel, by the size that it was learnt at. --page
    writes a page on which points are found by clicking. The field remembers the whole change (`fieldpose info FIELD`),
    and --reset takes it back. The JSON file has: object_from_dataset (scale, rotation by rows, translation: x = scale *
    rotation d + translation), unit, metres_per_unit (null: not known), measured (the known distance before).
    """

    field: tyro.conf.Positional[Path]
    """The field (.safetensors)."""
    up: str | None = None
    """What becomes z: a direction X,Y,Z, or "plane", away from what the object stands on."""
    origin: str | None = None
    """What becomes the origin: a point, or "plane", the one on it under what the cameras look at."""
    known_distance: tuple[str, str, float] | None = None
    """Two points and the metres between them; from now on lengths are in metres."""
    scale: float | None = None
    """Lengths become so many times as large."""
    metres_per_unit: float | None = None
    """Say how many metres long the unit is; no number changes."""
    reset: bool = False
    """Take the dataset's own frame and unit again."""
    out: Path | None = None
    """Write the field here instead of where it was."""
    page: Path | None = None
    """Only write a page (.html) with views of the field, where points are clicked and this command is put together."""
    json: Path | None = None
    """Write the change into this file."""

    def run(self) -> int:
        """Change the frame, say what it is now."""
        from fieldpose.stages.nerf.field import load_field
        from fieldpose.stages.nerf.loading import make_renderer

        out = self.out or self.field
        check_writable(out, self.json, self.page)
        for complaint in self._complaints():
            raise UsageError(complaint)
        field = load_field(self.field)
        renderer = make_renderer(field, usable_cores())
        if self.page is not None:
            from fieldpose.deploy.reporting.picking import page

            write_bytes(self.page, page(renderer, field.metadata, self.field))
            print(
                f"{self.page}: open it in a browser, and click the ends of a known length, the origin or what is level"
            )
            return 0
        framing = Framing(renderer, field.metadata)
        measured = self._applied(framing)
        framing.check()
        for note in framing.notes:
            progress_console().print(f"note: {note}", markup=False, soft_wrap=True)
        field.metadata = framing.metadata
        try:
            field.save(out)
        except OSError as error:
            raise OutputError(f"{out}: cannot be written: {error.strerror}") from error
        frame = msgspec.to_builtins(field.metadata.frame)
        told = {"unit": field.metadata.unit, "metres_per_unit": field.metadata.metres_per_unit, "measured": measured}
        write_json(self.json, {"object_from_dataset": frame, **told})
        if measured is not None and self.known_distance is not None:
            print(f"the two points were {measured:.4g} apart, and are {self.known_distance[2]:g} m apart now")
        print(f"{out}: {frame_in_words(field.metadata)}")
        return 0

    def _applied(self, framing: Framing) -> float | None:
        if self.reset:
            framing.back()
            return None
        measured = None
        if self.up is not None:
            framing.turn(self.up)
        if self.origin is not None:
            framing.move(self.origin)
        if self.known_distance is not None:
            measured = framing.measure(*self.known_distance)
        if self.scale is not None:
            framing.scale(self.scale)
        if self.metres_per_unit is not None:
            framing.say_metres(self.metres_per_unit)
        return measured

    def _complaints(self) -> Iterator[str]:
        changes = (self.up, self.origin, self.known_distance, self.scale, self.metres_per_unit)
        if self.page is not None and (self.reset or any(o is not None for o in (*changes, self.out, self.json))):
            yield "--page only writes the page; change the frame by another call"
        if self.reset and any(change is not None for change in changes):
            yield "--reset takes everything back; give the other options in a second call"
        if self.page is None and not self.reset and all(change is None for change in changes):
            yield "nothing to change; give --up, --origin, --known-distance, --scale, --metres-per-unit or --reset"
        if sum(change is not None for change in (self.known_distance, self.scale, self.metres_per_unit)) > 1:
            yield "--known-distance, --scale and --metres-per-unit each say how long the unit is; give one of them"
        if self.page is not None and self.page.suffix != ".html":
            yield f"--page {self.page}: expected a name that ends in .html"
        metres = None if self.known_distance is None else self.known_distance[2]
        for name, length in (
            ("--known-distance", metres), ("--scale", self.scale), ("--metres-per-unit", self.metres_per_unit)
        ):  # fmt: skip
            if length is not None and not 0 < length < float("inf"):
                yield f"{name} {length:g}: must be more than 0"
