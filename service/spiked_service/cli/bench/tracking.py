"""Tracking speed, frames to poses on one core, with the error of the path."""

import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.evaluate import PoseErrors, score_trajectory
from spiked.measurement import Measurement
from spiked.recon import Options, Reconstructor
from spiked.recording import open_recording
from spiked.sensor import Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.trajectory import Trajectory

CHUNK_FRAMES = 64
"""Frames fed at a time."""


@dataclass(frozen=True)
class Setting:
    """Window length and target speed."""

    window_frames: int
    target_hz: int
    flow_px: float
    """Image motion a frame of the simulated stream."""
    frames: int
    """Of the simulated stream."""


SETTINGS = (Setting(16, 4_000, 0.12, 1_920), Setting(64, 20_000, 0.03, 3_840))


@dataclass(frozen=True)
class BenchmarkRecording:
    """Stored frames [n, frame_bytes] of a sensor, and the truth."""

    sensor: Sensor
    frames: NDArray[np.uint8]
    truth: Trajectory


@dataclass(frozen=True)
class Tracking:
    """Result of tracking a stream, in CPU time of one thread."""

    steady_hz: float
    """Frames a second once there is a path: reduction to windows, tracks, poses, adjustments."""
    all_hz: float
    """From the first frame on, with the search for the first map."""
    frames: int
    """After the first path."""
    errors: PoseErrors | None
    """Of the final path, before any map; None if no path was found."""


def rows(folder: Path | None = None, settings: tuple[Setting, ...] = SETTINGS) -> list[Measurement]:
    """A row for each setting, on a stream as `spiked simulate` writes it in `folder`, or on a simulated room."""
    found = []
    recorded = None if folder is None else read(folder)
    for setting in settings:
        stream = recorded or simulated(setting)
        done = follow(stream, setting.window_frames)
        error = "no path" if done.errors is None else f"ATE {done.errors.ate_percent:.2f} %"
        where = f"{stream.sensor.width}x{stream.sensor.height}"
        found.append(
            Measurement(
                f"tracking, {setting.window_frames}-frame views, {where}, {done.frames} frames",
                done.steady_hz,
                "frames/s",
                done.steady_hz / setting.target_hz,
                f"of the target; {error}; {done.all_hz:.0f} frames/s with the first map",
                f">= {setting.target_hz}",
            )
        )
    return found


def read(folder: Path) -> BenchmarkRecording:
    """The one recording of a folder, with the truth beside it. Raises ConfigurationError where there is not one."""
    recordings = sorted(folder.glob("*.dat"))
    if len(recordings) != 1:
        raise ConfigurationError(f"{folder} holds {len(recordings)} recordings; name a folder with one .dat")
    recording = open_recording(recordings[0])
    frames = recording.read(0, recording.frames).copy()
    return BenchmarkRecording(recording.sensor, frames, Trajectory.read_tum(folder / "groundtruth.tum"))


def simulated(setting: Setting) -> BenchmarkRecording:
    """The built-in room, 400x250 at 20 kHz."""
    camera = SimulatedCamera(Sensor(400, 250, 20_000.0), 0, MotionKind.ARC, flow_px=setting.flow_px)
    frames = np.concatenate([camera.next_frames(CHUNK_FRAMES) for _ in range(setting.frames // CHUNK_FRAMES)])
    numbers = np.arange(len(frames), dtype=float)
    truth = Trajectory((numbers + 0.5) / camera.sensor.frame_rate_hz, *camera.truth(numbers))
    return BenchmarkRecording(camera.sensor, frames, truth)


def follow(stream: BenchmarkRecording, window_frames: int) -> Tracking:
    """Track a stream in views of so many frames, on one thread."""
    reconstructor = Reconstructor(stream.sensor, Options(window_frames=window_frames, steps=0, threads=1))
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        begin = time.thread_time()
        first, first_s = 0, begin
        for frame in range(0, len(stream.frames), CHUNK_FRAMES):
            reconstructor.feed(frame, stream.frames[frame : frame + CHUNK_FRAMES])
            if first == 0 and reconstructor.path is not None:
                first, first_s = frame + CHUNK_FRAMES, time.thread_time()
        end = time.thread_time()
    finally:
        cv2.setNumThreads(threads)
    if first == 0:
        return Tracking(0.0, len(stream.frames) / (end - begin), 0, None)
    reconstructor.finish()
    score = score_trajectory(
        truth=stream.truth, estimate=reconstructor.trajectory(), frame_rate_hz=stream.sensor.frame_rate_hz
    )
    left = len(stream.frames) - first
    return Tracking(left / max(end - first_s, 1e-9), len(stream.frames) / (end - begin), left, score.errors)
