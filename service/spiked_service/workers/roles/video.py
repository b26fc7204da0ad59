"""The video worker: writes a recording in slow motion."""

import os
from dataclasses import replace

import numpy as np

from spiked.errors import ConfigurationError
from spiked.export.video import MOST_PICTURES
from spiked.recording import open_recording
from spiked.video import Mp4Writer, SlowMotion, slow_motion
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import VideoCommand
from spiked_service.workers.roles.export import NICE, disk_told

DEFAULT_S = 10.0
"""Length of a video whose slowness is not chosen, seconds."""


def run_video(command: VideoCommand, channel: WorkerChannel) -> None:
    """Write the file whole or not at all; pictures whose frames were lost are black.

    Raises DiskFullError, and SpikedError for what the user can correct.
    """
    os.nice(NICE)
    recording = open_recording(command.recording)
    how = SlowMotion(
        command.slower or 1.0,
        command.pictures_a_second,
        command.window,
        command.compensated,
        command.begin_s,
        command.end_s,
    )
    length_s = how.duration_s(recording) * command.slower if command.slower else DEFAULT_S
    if length_s * how.pictures_a_second > MOST_PICTURES:
        raise ConfigurationError(
            f"{length_s:.4g} s with {how.pictures_a_second:g} pictures a second are more than {MOST_PICTURES:,} "
            "pictures: show a part of the recording, or less slowly"
        )
    how = replace(how, slower=length_s / how.duration_s(recording))
    black = np.zeros((recording.sensor.height, recording.sensor.width), np.uint8)
    with disk_told(), Mp4Writer(command.out, how.pictures_a_second) as video:
        for picture in slow_motion(recording, how):
            video.write(black if picture is None else picture)
