"""The localisation worker: finds where the camera of a recording was in a map."""

import logging
import os
from collections.abc import Iterator
from dataclasses import replace

from spiked.calibration import Calibration
from spiked.errors import RecordingError
from spiked.recon import Localiser, MapIndex
from spiked.recording import Recording, open_recording, recorded_calibration
from spiked_service.results.localisation_figures import localisation_figures
from spiked_service.results.map_folder import camera_in
from spiked_service.results.map_reports import LOCALISATION
from spiked_service.results.pinned_map import PinnedMap
from spiked_service.results.recording_feed import Piece, pieces
from spiked_service.store.rows import FrameRange, Stage
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.map_job_reporter import MapJobReporter
from spiked_service.workers.messages import LocalisationCommand

_log = logging.getLogger("spiked.localisation")
_NICE = 10
"""Niceness: live captures have priority."""


def run_localisation(command: LocalisationCommand, channel: WorkerChannel) -> None:
    """Localise the frames, and publish their path in the scene of the map.

    Raises ConfigurationError, RecordingError or SceneError for errors that the user can correct.
    """
    os.nice(_NICE)
    reporter = MapJobReporter(command.folder, channel, Stage.TRACKING)
    recording = open_recording(command.recording)
    chosen = list(_within(recording, command.part))
    if not chosen:
        raise RecordingError(f"none of the frames to localise are recorded: there are {recording.frames} frames")
    sensor = replace(recording.sensor, intrinsics=command.intrinsics or recording.sensor.intrinsics)
    known = PinnedMap.read(command.map).known(command.map)
    camera = camera_in(sensor, known.camera)
    calibration = recorded_calibration(recording.path)
    measured = None if calibration is None else Calibration.read(calibration)
    localiser = Localiser(MapIndex(known.scene, known.trajectory, camera, command.threads), sensor, measured)
    total, fed = sum(piece.count for piece in chosen), 0
    for piece in chosen:
        if channel.leave.is_set():
            return
        localiser.feed(piece.index, recording.read(piece.first, piece.count))
        fed += piece.count
        reporter.progress(0.99 * fed / total, fed)
    found = localiser.finish()
    _log.info(found.reason)
    figures = localisation_figures(found, sensor)
    if not found.recognised:
        reporter.refuse(found.reason, LOCALISATION, figures)
        return
    path = found.trajectory(sensor.frame_rate_hz)
    reporter.publish(known.scene, path, camera.intrinsics, LOCALISATION, figures, fed)


def _within(recording: Recording, part: FrameRange | None) -> Iterator[Piece]:
    """The pieces of a recording that lie in a part of its capture."""
    for piece in pieces(recording):
        begin, end = piece.index, piece.index + piece.count
        if part is not None:
            begin, end = max(begin, part.first), min(end, part.first + part.count)
        if begin < end:
            yield Piece(piece.first + begin - piece.index, end - begin, begin)
