"""From a video or photographs to tracking, in one command."""

from __future__ import annotations

import resource
import shutil
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import tyro
from rich.table import Table

from fieldpose.deploy.commands import capture, run, train
from fieldpose.deploy.reporting.output import check_writable, result_console, write_json
from fieldpose.errors import FieldposeError, OutputError, UsageError
from fieldpose.stages.nerf.datasets.transforms import FILE

DATASET, FIELD, KEPT = "dataset", "field.safetensors", "start.json"
_MEBI = 1 << 20


@dataclass
class _Kept:
    """What the steps were made of, by their names; a step whose own is the same is not done again."""

    path: Path
    made_of: dict[str, dict[str, Any]] = field(default_factory=dict)

    def has(self, step: str, made_of: dict[str, Any]) -> bool:
        return self.made_of.get(step) == msgspec.to_builtins(made_of)

    def of(self, step: str) -> dict[str, Any]:
        return self.made_of.get(step, {})

    def note(self, step: str, made_of: dict[str, Any]) -> None:
        self.made_of[step] = msgspec.to_builtins(made_of)
        write_json(self.path, self.made_of)


@dataclass(frozen=True)
class _Row:
    step: str
    result: str
    seconds: float | None
    peak_mb: float


@dataclass(frozen=True)
class Options:
    """Capture a video or photographs, learn a field of what they show, and find the camera of another video or device.

    Example: fieldpose start can.mp4 --on camera:0

    Does what `capture`, `train` and `run` do, one after the other, with what each of them says; look there for more to
    set. Everything goes into one folder: dataset/, field.safetensors with its picture (.jpg, from the first fifth of
    the training on) and its turntable (.mp4), and of each run a folder run-NAME with poses.csv, run.json and
    timeline.png. Given again, the command goes on where it was ended, and does not do again what is there. The JSON
    file has: steps (step, result,
    seconds: null where it was there already, peak_mb: the most memory of this process and its children so far).
    """

    source: tyro.conf.Positional[str]
    """A video file, a folder of photographs, or a source as `run` takes it (camera:0 films until Ctrl-C)."""
    on: str | None = None
    """What the camera is found of in the end: a video file, camera:0 or any other source of `run`; without, only the
    field is made."""
    out: Path | None = None
    """The folder to write; by default out/ and the name of the source."""
    minutes: float | None = None
    """How long to learn, 5 by default; what it takes to look before and to try the field after comes on top."""
    view: bool = False
    """Serve a page that shows the run, and print its address; see `fieldpose view`."""
    only: Literal["box", "masks"] | None = None
    """Learn the object alone, so that it is found wherever it is moved: what is in the box that `capture` puts around
    it, or what masks show."""
    marker: float | None = None
    """Length of the side of a printed marker in view, in metres: frame and metres are then the marker's."""
    family: Literal["4x4", "5x5", "6x6", "7x7", "aruco", "tag16h5", "tag25h9", "tag36h11"] = "4x4"
    """Of the marker."""
    json: Path | None = None
    """Write what was done into this file."""

    def run(self) -> int:
        """Do the steps that are left, say what each took."""
        if self.minutes is not None and not 0 < self.minutes < float("inf"):
            raise UsageError(f"--minutes {self.minutes:g}: must be more than 0")
        if ":" not in self.source and not Path(self.source).exists():
            raise UsageError(f"{self.source}: no such file; expected a video, a folder of photographs, or camera:0")
        on = None if self.on is None else _source(self.on)
        folder = self._folder()
        kept, rows = self._kept(folder), list[_Row]()
        check_writable(kept.path, self.json)
        code = self._capture(folder, kept, rows) or self._train(folder, kept, rows) or self._run(folder, on, rows)
        write_json(self.json, {"steps": rows})
        _print(rows)
        if not code and self.on is None:
            print(f"next: the same command with --on camera:0 or --on VIDEO; `fieldpose info {folder / FIELD}`")
        return code

    def _folder(self) -> Path:
        if self.out is not None:
            return self.out
        folder = Path("out") / _name_of(self.source)
        if folder.resolve() == Path(self.source).resolve():
            raise UsageError(f"{folder}: is the source, and would be where everything goes; give --out")
        return folder

    def _kept(self, folder: Path) -> _Kept:
        path = folder / KEPT
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return _Kept(path)
        try:
            return _Kept(path, msgspec.json.decode(path.read_bytes(), type=dict[str, dict[str, Any]]))
        except (OSError, msgspec.DecodeError) as error:
            raise OutputError(f"{folder}: is there, but not made by `fieldpose start`; name another --out") from error

    def _capture(self, folder: Path, kept: _Kept, rows: list[_Row]) -> int:
        dataset = folder / DATASET
        made_of = {"source": _identity(self.source), "marker": self.marker, "family": self.family}
        if (dataset / FILE).is_file():
            if not kept.has("capture", made_of):
                raise OutputError(
                    f"{folder}: holds what was captured of another source, or with another marker; name another --out,"
                    " or remove it"
                )
            rows.append(_row("capture", str(dataset), None))
            return 0
        # Of a capture that was ended early.
        shutil.rmtree(dataset, ignore_errors=True)
        kept.note("capture", made_of)
        options = capture.Options(self.source, dataset, marker=self.marker, family=self.family)
        try:
            return _timed("capture", str(dataset), options.capture, rows)
        except FieldposeError:
            shutil.rmtree(dataset, ignore_errors=True)
            kept.path.unlink(missing_ok=True)
            with suppress(OSError):
                folder.rmdir()
            raise

    def _train(self, folder: Path, kept: _Kept, rows: list[_Row]) -> int:
        path = folder / FIELD
        made_of = {"dataset": (folder / DATASET / FILE).read_text(), "minutes": self.minutes, "only": self.only}
        if path.is_file():
            # A field that somebody has may have a frame of its own by now: never learnt anew without being asked.
            if self.minutes is None and kept.has("train", made_of | {"minutes": kept.of("train").get("minutes")}):
                made_of["minutes"] = kept.of("train").get("minutes")
            if not kept.has("train", made_of):
                raise OutputError(
                    f"{path}: was learnt for another time, of another dataset or of another part of it; name another"
                    " --out, or remove it to learn anew"
                )
            rows.append(_row("train", _with_picture(path), None))
            return 0
        options = train.Options(folder / DATASET, path, minutes=self.minutes, only=self.only)
        code = _timed("train", _with_picture(path), options.run, rows)
        if not code:
            kept.note("train", made_of)
        return code

    def _run(self, folder: Path, on: str | None, rows: list[_Row]) -> int:
        if on is None:
            return 0
        into = folder / f"run-{_name_of(on)}"
        written = into / "poses.csv"
        options = run.Options(
            (str(folder / FIELD),),
            (on,),
            json=into / "run.json",
            csv=written,
            plot=into / "timeline.png",
            view=self.view,
        )
        return _timed("run", f"{written}, timeline.png", options.run, rows)


def _with_picture(field: Path) -> str:
    return f"{field}, {field.with_suffix('.jpg').name}, {field.with_suffix('.mp4').name}"


def _name_of(source: str) -> str:
    path = Path(source)
    name = path.resolve().stem if path.exists() else Path(source.partition(":")[2] or source).stem
    return f"camera{name}" if name.isdecimal() else name


def _source(on: str) -> str:
    """As `run` takes it. UsageError for a file that is not there."""
    path = Path(on)
    if path.exists():
        return f"folder:{path}" if path.is_dir() else f"video:{path}"
    if ":" not in on:
        raise UsageError(f"--on {on}: no such file; expected a video, a folder or a source like camera:0")
    return on


def _identity(source: str) -> list[Any]:
    """By what a source is known again: its name, and of its files, when they were changed, and their sizes."""
    named = Path(source)
    path = named if named.exists() else Path(source.partition(":")[2])
    if not path.name or not path.exists():
        return [source]
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    stats = [(file, file.stat()) for file in files]
    return [str(path.resolve()), *([file.name, stat.st_mtime_ns, stat.st_size] for file, stat in stats)]


def _timed(step: str, result: str, do: Callable[[], int], rows: list[_Row]) -> int:
    print(f"== {step}", file=sys.stderr)
    began = time.monotonic()
    code = do()
    rows.append(_row(step, result, time.monotonic() - began))
    return code


def _row(step: str, result: str, seconds: float | None) -> _Row:
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return _Row(step, result, seconds, max(usage.ru_maxrss for usage in usages) * 1024 / _MEBI)


def _print(rows: list[_Row]) -> None:
    table = Table()
    for heading in ("step", "time", "most memory so far", "result"):
        table.add_column(heading, justify="right" if heading in ("time", "most memory so far") else "left")
    for row in rows:
        taken = "was there" if row.seconds is None else f"{row.seconds:.0f} s"
        table.add_row(row.step, taken, f"{row.peak_mb:.0f} MB", row.result)
    result_console().print(table)
