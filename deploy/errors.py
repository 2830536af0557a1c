"""Errors of the command line and of the processes that it starts; each message is one line for the user."""

from __future__ import annotations

from fieldpose.bus.errors import FieldposeError


class UsageError(FieldposeError):
    """A command line that cannot be understood."""


class ProcessError(FieldposeError):
    """A process of the pipeline that cannot start, or does not stay up."""


class OutputError(FieldposeError):
    """A file that cannot be written."""
