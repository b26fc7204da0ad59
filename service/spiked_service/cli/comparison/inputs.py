"""What a cell is made of: the recording and what lies beside it, told from others by its content."""

import hashlib
from functools import cache
from pathlib import Path

from spiked.errors import RecordingError
from spiked.recording import recorded_calibration, sidecar_path

GROUND_TRUTH, HELD_OUT, VIEWS = "groundtruth.tum", "views.json", "views"
"""Files and folder of the truth beside a recording."""
_GEOMETRY = "config.yaml"
"""Of the data sets of SpikeCV, beside a recording without sidecar."""
_DIGEST_BYTES = 16
"""Of BLAKE2b: it tells change, not malice."""


def digest_of_inputs(recording: Path) -> str:
    """A digest of the content of the recording, its sidecar, calibration and truth, in hex.

    A file is read again only after it was written or replaced. Raises RecordingError.
    """
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    try:
        for path in _inputs(recording):
            digest.update(path.name.encode(errors="surrogateescape") + b"\0")
            status = path.stat()
            digest.update(_content(path, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns))
    except OSError as error:
        raise RecordingError(f"{recording}: {error.filename} cannot be read: {error.strerror}") from error
    return digest.hexdigest()


def _inputs(recording: Path) -> list[Path]:
    beside = recording.parent
    calibration = recorded_calibration(recording)
    named = [recording, sidecar_path(recording), *([] if calibration is None else [calibration])]
    truth = [beside / name for name in (_GEOMETRY, GROUND_TRUTH, HELD_OUT)] + sorted((beside / VIEWS).glob("*"))
    return [path for path in named + truth if path.is_file()]


@cache
def _content(path: Path, *status: int) -> bytes:
    """The digest of a file; `status` tells the file that was read from a later one."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=_DIGEST_BYTES)).digest()
