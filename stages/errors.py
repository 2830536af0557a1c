"""Errors of the mathematics and of its inputs; independent of the bus so that the cores stay importable alone."""


class StageError(Exception):
    """Base of every error that a stage's user can mend; the command line prints it as one line."""


class DatasetError(StageError):
    """A dataset that cannot be used; the message names the file."""


class FieldFileError(StageError):
    """A field file that cannot be used."""


class WeightsError(StageError):
    """Network weights that cannot be found or read."""


class SourceError(StageError):
    """A camera source that cannot be opened or read."""


class ConfigError(StageError):
    """A setting that does not exist or has a value out of range."""
