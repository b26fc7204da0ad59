"""The exceptions of spiked. Each message says what is wrong, where, and what to do."""

__all__ = [
    "CalibrationError",
    "CheckpointError",
    "ConfigurationError",
    "DatasetError",
    "ProfileError",
    "RecordingError",
    "SceneError",
    "SourceError",
    "SpikedError",
]


class SpikedError(Exception):
    """Base of all errors that a user can fix; the command line prints the message on one line and exits with 2."""


class RecordingError(SpikedError):
    """A recording, its sidecar or its index cannot be used as asked."""


class IndexFileError(RecordingError):
    """The index of a recording cannot be used; the recording can be read without it."""


class SceneError(SpikedError):
    """A scene or trajectory file cannot be read or written."""


class SourceError(SpikedError):
    """A camera source cannot be opened or was asked for something it cannot do."""


class ConfigurationError(SpikedError):
    """An option has a value that cannot be used."""


class CalibrationError(SpikedError):
    """A calibration, or a recording to make one from, cannot be used."""


class ProfileError(SpikedError):
    """A camera profile cannot be read, written or used for a camera."""


class CheckpointError(SpikedError):
    """The checkpoint of an interrupted reconstruction cannot be used."""


class DatasetError(SpikedError):
    """A folder of a data set is incomplete, damaged, changed, or laid out otherwise than the data set is."""
