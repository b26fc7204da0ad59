"""The few exceptions a user of spiked meets. Each message says what was wrong, where, and what to do."""


class SpikedError(Exception):
    """Base of every error that is the user's to mend; the command line prints it on one line and exits with 2."""


class RecordingError(SpikedError):
    """A recording, its sidecar or its index cannot be used as asked."""


class SceneError(SpikedError):
    """A scene or trajectory file cannot be read or written."""


class SourceError(SpikedError):
    """A camera source cannot be opened or was asked for something it cannot do."""


class ConfigurationError(SpikedError):
    """An option has a value that cannot be used."""


class CalibrationError(SpikedError):
    """A calibration, or a recording to make one from, cannot be used."""
