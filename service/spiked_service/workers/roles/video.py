"""The video worker: writes a recording in slow motion."""

import os

import numpy as np

from spiked.recording import open_recording
from spiked.video import Mp4Writer, slow_motion
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import VideoCommand
from spiked_service.workers.roles.export import NICE, disk_told
from spiked_service.workers.slow_motion import slow_motion_of


def run_video(command: VideoCommand, channel: WorkerChannel) -> None:
    """Write the file whole or not at all; pictures whose frames were lost are black.

    Raises DiskFullError, and SpikedError for what the user can correct.
    """
    os.nice(NICE)
    recording = open_recording(command.recording)
    how = slow_motion_of(command, recording)
    black = np.zeros((recording.sensor.height, recording.sensor.width), np.uint8)
    with disk_told(), Mp4Writer(command.out, how.pictures_a_second) as video:
        for picture in slow_motion(recording, how):
            video.write(black if picture is None else picture)
