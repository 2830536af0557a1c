"""What commands give out: files that are whole or not there, and text for people."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from fieldpose.errors import OutputError

_FILE_WIDTH = 140
PICTURES = (".png", ".svg", ".pdf")
"""What a plot may be written as."""


def progress_console() -> Console:
    """Where progress goes: stderr, so that what a command prints can be read by other programs."""
    return Console(stderr=True)


@contextmanager
def progress_bar(command: str) -> Iterator[Callable[[str, float], None]]:
    """Gives a function that shows what is done and its share, as lines of that command where stderr is no terminal."""
    console = progress_console()
    columns = (BarColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task, last = bar.add_task("reading", total=1.0), ""

        def report(what: str, share: float) -> None:
            nonlocal last, task
            if what != last:
                bar.remove_task(task)
                task = bar.add_task(what, total=1.0)
                if not console.is_terminal:
                    console.print(f"{command}: {what}")
            last = what
            bar.update(task, completed=share)

        yield report


def result_console() -> Console:
    """Where results go: stdout, with room for tables where that is no terminal."""
    console = Console()
    return console if console.is_terminal else Console(width=_FILE_WIDTH)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file under a temporary name, then give it its own. Raises OutputError."""
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content)
        os.replace(partial, path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def write_json(path: Path | None, value: Any) -> None:
    """Write anything that msgspec can encode as indented JSON; nothing where `path` is None. Raises OutputError."""
    if path is not None:
        write_bytes(path, msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n")


def check_picture(path: Path | None) -> None:
    """Raise OutputError where a plot could not be written later, for its place or its kind."""
    check_writable(path)
    if path is not None and path.suffix not in PICTURES:
        raise OutputError(f"{path}: no name of a plot; end it in {', '.join(PICTURES[:-1])} or {PICTURES[-1]}")


def check_new_folder(path: Path) -> None:
    """Raise OutputError where a folder that is empty or not there could not be written later."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise OutputError(f"{path}: is there already and not empty; name another folder, or remove it")
    whole = path.absolute()
    check_writable(whole.with_name(f"{whole.name}.partial"))


def check_writable(*paths: Path | None) -> None:
    """Raise OutputError where a file could not be written later, before long work is begun."""
    for path in paths:
        if path is None:
            continue
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; give the name of a file")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{path}: its folder cannot be made: {error.strerror}") from error
        if not os.access(path.parent, os.W_OK):
            raise OutputError(f"{path}: no right to write in {path.parent}")
