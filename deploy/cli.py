"""The `fieldpose` command: finds the subcommand, reads its options, and turns the user's mistakes into one line.

Only the module of the command that was asked for is imported. Such a module has `Options`, a frozen dataclass whose
fields are the options, with a method `run` that returns the exit code, and its docstring is the command's help.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import importlib
import io
import re
import sys
from pathlib import Path
from typing import Any

from fieldpose.errors import UsageError

COMMANDS = {
    "demo": "the embedded scene through the whole pipeline",
    "start": "a video or photographs -> tracking, in one command",
    "capture": "a video or photographs -> posed images to train on",
    "convert": "posed images of one kind as those of another, for other programs",
    "calibrate": "a printed board in a video or photographs -> a camera file",
    "train": "posed images -> a field (.safetensors)",
    "estimate": "one image, in one process, without a bus",
    "run": "the pipeline: a source of images through every stage, each a process",
    "top": "what the processes of a running pipeline do, as a table that lives",
    "view": "a page that shows a running pipeline, or a recording",
    "stage": "one process of the pipeline, for another host or a debugger",
    "certs": "certificates by role, for a pipeline on several hosts",
    "deploy": "files that start a pipeline on several hosts: Docker Compose, Kubernetes, systemd",
    "record": "record a pipeline that is running",
    "control": "reset the tracking of a pipeline that is running, give it a guess, or ask how it is",
    "bridge": "a running pipeline as a node of ROS 2, or live in Foxglove",
    "replay": "run the pipeline again on a recording's frames and compare the poses",
    "info": "what a recording holds, topic by topic, and what it lacks; what a field says of itself",
    "poses": "a recording's poses for other programs: TUM's trajectories, COLMAP's models, CSV",
    "export": "a field's surface as a mesh or points; a recording for Foxglove, or as a video",
    "edit": "a recorded sequence with a disturbance in it, to test how far tracking can be trusted",
    "recover": "save what can be saved of an unfinished or damaged recording",
    "frame": "turn, move and scale the frame that a field's poses are in",
    "crop": "a field of the object alone, out of one of all that is around it",
    "evaluate": "how well poses are found on a dataset, method by method",
    "bench": "how fast the parts are on this machine",
    "doctor": "check this machine, the bus, the weights, a dataset",
}
_BAD_INPUT, _INTERRUPTED = 2, 130
_FRAME = " \t│╭╮╰╯"


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns 0 on success only, 2 for bad input, 130 after Ctrl-C."""
    arguments = sys.argv[1:] if argv is None else argv
    try:
        return _dispatch(arguments)
    except KeyboardInterrupt:
        return _INTERRUPTED
    except BrokenPipeError:
        # Whoever read our output went away; Python would complain again when it flushes at the end.
        sys.stdout = None
        return 1
    except Exception as error:
        from fieldpose.errors import FieldposeError

        if not isinstance(error, FieldposeError):
            raise
        print(f"fieldpose: {' '.join(str(error).split())}", file=sys.stderr)
        return _BAD_INPUT


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return 0 if arguments else _BAD_INPUT
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(f"fieldpose {version('fieldpose')}")
        return 0
    name, *rest = arguments
    if name not in COMMANDS:
        meant = difflib.get_close_matches(name, COMMANDS, 1)
        hint = f" (did you mean {meant[0]}?)" if meant else ""
        raise UsageError(f"no command {name!r}{hint}; expected one of {', '.join(COMMANDS)}")
    module = importlib.import_module(f"fieldpose.deploy.commands.{name}")
    return int(parse(module.Options, name, rest).run())


def parse(options: type[Any], name: str, arguments: list[str]) -> Any:
    """Options of a command from its arguments; `--config FILE` changes the defaults. Raises UsageError."""
    import tyro

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(
                options,
                prog=f"fieldpose {name}",
                args=arguments,
                default=_defaults(options, arguments),
                config=(tyro.conf.HelptextFromCommentsOff,),
            )
    except SystemExit as end:
        if not end.code:
            raise
        raise UsageError(f"{_one_line(complaint.getvalue())}; see `fieldpose {name} --help`") from None


def _defaults(options: type[Any], arguments: list[str]) -> Any:
    """Options with the settings of the configuration file, where the command has both and one is given."""
    given = _value_of("--config", arguments)
    names = {field.name: field for field in dataclasses.fields(options)}
    if given is None or "settings" not in names:
        return None
    import tyro

    from fieldpose.deploy.settings import read_settings

    required = [name for name, field in names.items() if _is_required(field)]
    settings_of = getattr(options, "settings_of", read_settings)
    return options(**dict.fromkeys(required, tyro.MISSING), settings=settings_of(Path(given)))


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _value_of(flag: str, arguments: list[str]) -> str | None:
    for argument, following in zip(arguments, [*arguments[1:], None], strict=False):
        if argument == flag:
            return following
        if argument.startswith(flag + "="):
            return argument.removeprefix(flag + "=")
    return None


def _one_line(framed: str) -> str:
    """The first part of tyro's framed message, and the first option that it suggests.

    The frame has a title, and lines between its parts; it is drawn with dashes where the terminal has nothing else.
    """
    lines = [line.strip(_FRAME) for line in framed.splitlines()][1:]
    parts = [part.strip() for part in re.split(r"(?m)^[─-]+$", "\n".join(lines))]
    first, *others = [part for part in parts if part] or ["cannot be understood"]
    suggested = next((re.search(r"--[\w.-]+", part) for part in others if part.startswith("Perhaps")), None)
    text = " ".join(first.split())
    return f"{text} (did you mean {suggested.group()}?)" if suggested else text


def _overview() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {what}" for name, what in COMMANDS.items())
    return f"""usage: fieldpose COMMAND [OPTIONS]

Finds, in real time, where a camera is relative to an object or scene known from posed photographs.

{rows}

`fieldpose COMMAND --help` describes one and gives an example; for instance: fieldpose demo"""
