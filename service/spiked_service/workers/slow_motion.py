"""How the recording of a command is shown in slow motion."""

from dataclasses import replace

from spiked.recording import Recording
from spiked.video import SlowMotion
from spiked.video.limits import check_size
from spiked_service.workers.messages import VideoCommand

USUAL_S = 10.0
"""Length of a video whose slowness is not chosen, seconds."""
COMPENSATION = 8.0
"""Work for a pixel whose motion is compensated, over that of a rendered one: flow to two neighbours and back."""
EASY_WINDOW = 2048
"""Frames of a picture that take as long to read as a picture to render."""


def slow_motion_of(command: VideoCommand, recording: Recording) -> SlowMotion:
    """The video. Raises ConfigurationError for an empty or too large one."""
    how = SlowMotion(
        command.slower or 1.0,
        command.pictures_a_second,
        command.window,
        command.compensated,
        command.begin_s,
        command.end_s,
    )
    duration_s = how.duration_s(recording)
    length_s = duration_s * command.slower if command.slower else USUAL_S
    effort = (1 + how.window / EASY_WINDOW) * (COMPENSATION if how.compensated else 1)
    check_size(length_s, how.pictures_a_second, recording.sensor.width, recording.sensor.height, effort)
    return replace(how, slower=length_s / duration_s)
