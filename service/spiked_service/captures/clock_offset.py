"""How the frames of two captures lie in time."""

from spiked.errors import RecordingError
from spiked.recording import open_recording
from spiked.recording.time_base import Offset, offset
from spiked_service.captures.captures import Captures


def clock_offset(captures: Captures, first_id: str, second_id: str) -> Offset:
    """From the first frame of the one to that of the other, by the clock pairs of their recordings.

    Raises RecordingError if a recording or its clock pairs are missing, UnknownIdError.
    """
    ids = (first_id, second_id)
    for one in ids:
        if captures.get(one).row.recording is None:
            raise RecordingError(f"capture {one} has no recording")
    try:
        first, second = (open_recording(captures.recording(one)) for one in ids)
        return offset(first, second)
    except RecordingError as error:
        why = str(error)
        for one in ids:
            why = why.replace(str(captures.recording(one)), f"the recording of capture {one}")
        raise RecordingError(why) from error
