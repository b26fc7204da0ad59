"""Publishes the progress and the result of a job that works on maps: localisation and merge."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from spiked.errors import SceneError
from spiked.recon import State
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory
from spiked_service.results.map_reports import write_report
from spiked_service.results.versions import Publisher, RecordedPath
from spiked_service.store.rows import Stage
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import PlaceCompared, ReconstructionStatus, VersionPublished

_STATUS_S = 0.2
"""Interval of status events, seconds."""


class MapJobReporter:
    """Sends events to the service, and writes a report and one version into the folder of the job."""

    def __init__(self, folder: Path, channel: WorkerChannel, stage: Stage) -> None:
        self._folder = folder
        self._channel = channel
        self._stage = stage
        self._publisher = Publisher(folder)
        self._begun_s: float | None = None
        self._sent_s = -np.inf
        self.progress(0.0)

    def progress(self, share: float, frames: int = 0) -> None:
        """The share of the work that is done, and the frames taken so far; the first call begins the estimate."""
        now_s = time.monotonic()
        if now_s - self._sent_s < _STATUS_S and share < 1:
            return
        self._sent_s = now_s
        self._begun_s = self._begun_s if share else now_s
        begun_s = now_s if self._begun_s is None else self._begun_s
        eta_s = (now_s - begun_s) * (1 - share) / share if share > 0.02 else None
        self._send(self._stage, State.BOOT, frames, share, eta_s)

    def refuse(self, reason: str, report: str, figures: Mapping[str, object]) -> None:
        """Not one place: write the report, and nothing is published. Raises SceneError if the disk is full."""
        self._write(report, figures)
        self._channel.send(PlaceCompared(recognised=False, reason=reason))

    def publish(
        self,
        scene: Scene,
        trajectory: Trajectory,
        optics: Intrinsics,
        report: str,
        figures: Mapping[str, object],
        frames: int = 0,
        others: Sequence[RecordedPath] = (),
    ) -> None:
        """Write report and version. Raises SceneError if the disk is full."""
        states = np.full(len(trajectory), str(State.TRACK).encode(), "S8")
        try:
            published = self._publisher.publish(
                scene, trajectory, scene.colour_of_white, None, optics, states, tolerance=0.0, others=others
            )
        except OSError as error:
            raise _write_error(error) from error
        self._write(report, figures)
        self._channel.send(PlaceCompared(recognised=True, reason=""))
        self._channel.send(VersionPublished(published=published, kept=self._publisher.kept))
        self._send(Stage.DONE, State.TRACK, frames, 1.0, None, published.poses, published.splats)

    def _write(self, report: str, figures: Mapping[str, object]) -> None:
        try:
            write_report(self._folder, report, figures)
        except OSError as error:
            raise _write_error(error) from error

    def _send(
        self,
        stage: Stage,
        state: State,
        frames: int,
        share: float,
        eta_s: float | None,
        poses: int = 0,
        splats: int = 0,
    ) -> None:
        self._channel.send(
            ReconstructionStatus(
                state=state,
                reason="",
                stage=stage,
                frames=frames,
                splats=splats,
                loss=None,
                progress=share,
                poses=poses,
                version=self._publisher.version,
                eta_s=eta_s,
            )
        )


def _write_error(error: OSError) -> SceneError:
    return SceneError(f"the result cannot be written: {error.strerror}; free disk space")
