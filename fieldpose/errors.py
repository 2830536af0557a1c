"""The one tree of errors that fieldpose raises on purpose; each message says what was got and how to mend it."""


class FieldposeError(Exception):
    """Base of every error that is the user's to mend; the command line prints it as one line."""


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
