"""The one tree of errors that fieldpose raises on purpose; each message says what was got and how to mend it."""


class FieldposeError(Exception):
    """Base of every error that is the user's to mend; the command line prints it as one line."""


class CodecError(FieldposeError):
    """Bytes that are not a message of the topic that they came on."""


class TransportError(FieldposeError):
    """The bus cannot be reached, or a stage that should be on it is not."""


class RecordingError(FieldposeError):
    """A recording that cannot be read or written."""
