"""The one tree of errors that fieldpose raises on purpose; each message says what was got and how to mend it."""

from __future__ import annotations

import re

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")
_LONGEST = 2000


def one_line(text: object) -> str:
    """Text as one line that any terminal shows, whatever is quoted in it from a file; cut off where it is very long."""
    line = _CONTROL.sub(" ", str(text)[: 2 * _LONGEST]).strip().encode("utf-8", "backslashreplace").decode()
    return line if len(line) <= _LONGEST else f"{line[:_LONGEST]}…"


class FieldposeError(Exception):
    """Base of every error that is the user's to mend; its text is one line."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class CodecError(FieldposeError):
    """Bytes that are not a message of the topic that they came on."""


class TransportError(FieldposeError):
    """The bus cannot be reached, or a process that should be on it is not."""


class RefusedError(FieldposeError):
    """A request to a running pipeline that it does not carry out."""


class RecordingError(FieldposeError):
    """A recording that cannot be read or written."""


class GeometryError(FieldposeError, ValueError):
    """Numbers that make no camera, or no rigid transform."""


class DatasetError(FieldposeError):
    """A dataset that cannot be used; the message names the file."""


class FieldFileError(FieldposeError):
    """A field file that cannot be used."""


class WeightsError(FieldposeError):
    """Network weights that cannot be found or read."""


class SourceError(FieldposeError):
    """A camera source that cannot be opened or read."""


class ConfigError(FieldposeError):
    """A setting that does not exist or has a value out of range."""


class UsageError(FieldposeError):
    """A command line that cannot be understood."""


class ProcessError(FieldposeError):
    """A process of the pipeline that cannot start, or does not stay up."""


class OutputError(FieldposeError):
    """A file that cannot be written."""
