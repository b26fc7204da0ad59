"""The recordings of a calibration, taken while a person covers the lens and uncovers it."""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.progress import Progress
from spiked_driver import open_camera, open_source

from spiked.calibration import LEAST_FRAMES, LONGEST_FRAMES, Calibration
from spiked.errors import CalibrationError, ConfigurationError, SourceError
from spiked.recording import Recording, RecordingWriter, open_recording
from spiked.ring import End, Gap
from spiked_service.base.signals import read_line
from spiked_service.cli.console import messages, report_error, report_warning

_READ_FRAMES = 256
"""Frames that are read at once, at most."""
_PATIENCE_S = 10.0
"""Time without a frame after which a camera counts as silent, seconds."""
_DARK = "Cover the lens completely, and press Enter"
_LIGHT = (
    "Uncover it, and point the camera at something even and bright, out of focus: a white wall, or paper before the "
    "lens. Press Enter; or write s and press Enter to measure no gains"
)


def take_recordings(source: str, seconds: float, folder: Path) -> tuple[Recording | None, Recording]:
    """Recordings of an even light, if it was not left out, and of the dark, in `folder`.

    What is unsuitable is said, and asked for again. Raises SourceError for a camera that cannot be read, and
    ConfigurationError if nobody answers.
    """
    open_source(source)  # what is wrong with its text is said before anybody covers a lens
    dark = _taken(source, seconds, folder / "dark.dat", _DARK, lambda taken: Calibration.measure(None, taken))
    assert dark is not None, "only the light can be left out"
    light = _taken(
        source, seconds, folder / "light.dat", _LIGHT, lambda taken: Calibration.measure(taken, dark), optional=True
    )
    return light, dark


def _taken(
    source: str, seconds: float, path: Path, request: str, check: Callable[[Recording], object], optional: bool = False
) -> Recording | None:
    while True:
        if _answer(request) == "s" and optional:
            return None
        taken = record_still(source, seconds, path)
        try:
            check(taken)
        except CalibrationError as error:
            report_error(error)
            for file in path.parent.glob(f"{path.stem}.*"):
                file.unlink()
            continue
        return taken


def _answer(request: str) -> str:
    """What is written after a request. Raises ConfigurationError at the end of the input."""
    messages.print(request, markup=False, style="bold")
    line = read_line(sys.stdin.fileno())
    if not line:
        raise ConfigurationError("--device asks for the lens to be covered and uncovered, and nobody answers")
    return line.strip().lower()


def record_still(source: str, seconds: float, path: Path) -> Recording:
    """Record so many seconds of a source, at most what a calibration uses; lost frames are counted and left out.

    Raises SourceError for a source that is silent or ends early, and RecordingError for a full disk.
    """
    opened = open_camera(source, report_warning)
    camera, sensor = opened.source, opened.source.sensor
    wanted = int(np.clip(round(seconds * sensor.frame_rate_hz), LEAST_FRAMES, LONGEST_FRAMES))
    view = np.empty((min(wanted, _READ_FRAMES), sensor.compact().frame_bytes), np.uint8)
    lost, heard_s = 0, time.monotonic()
    with (
        RecordingWriter(path, sensor, assumed=opened.assumed) as writer,
        Progress(console=messages, transient=True) as bar,
    ):
        task = bar.add_task("recording", total=wanted)
        camera.open()
        try:
            while writer.frames < wanted:
                item = camera.read_into(view[: wanted - writer.frames])
                if item is None:
                    if time.monotonic() - heard_s > _PATIENCE_S:
                        reason = camera.device_status.reason or "the camera is silent"
                        raise SourceError(f"{source}: no frame for {_PATIENCE_S:g} s: {reason}")
                    continue
                heard_s = time.monotonic()
                if isinstance(item, End):
                    raise SourceError(f"{source} ended after {writer.frames} frames, and {wanted} are needed")
                if isinstance(item, Gap):
                    lost += item.count
                    continue
                writer.append(view[: item.frames])
                bar.update(task, completed=writer.frames)
        finally:
            camera.close()
    if lost:
        report_warning(f"{lost} frames were lost; the calibration does without them")
    return open_recording(path)
