"""Versions of a live capture are written while the camera is tracked."""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from pydantic import BaseModel
from spiked_service.results.versions import Publisher
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.workers import progress_reporter
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import ReconstructionCommand, ReconstructionStatus, VersionPublished
from spiked_service.workers.progress_reporter import ProgressReporter
from waiting import until

from spiked.errors import SceneError
from spiked.recon import Options, Reconstructor
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

SENSOR = Sensor(160, 100, 20_000.0, intrinsics=Intrinsics.from_fov(160, 100, 60))
FRAMES = 600


@pytest.fixture(scope="module")
def tracked() -> Reconstructor:
    """A live reconstruction with a path and a map."""
    made = Reconstructor(SENSOR, Options(steps=0), live=True)
    camera = SimulatedCamera(SENSOR, seed=1, motion=MotionKind.HAND_SHAKE)
    for first in range(0, FRAMES, 100):
        made.feed(first, camera.next_frames(100))
    assert made.path is not None
    made.improve(0.2)
    return made


class Told:
    """What a worker has told the service."""

    def __init__(self) -> None:
        self.events: list[BaseModel] = []

    def send(self, event: BaseModel) -> None:
        self.events.append(event)

    def try_send(self, event: BaseModel) -> bool:
        self.send(event)
        return True

    @property
    def versions(self) -> list[int]:
        return [event.published.version for event in self.events if isinstance(event, VersionPublished)]


def reporter_of(made: Reconstructor, folder: Path, told: Told, live: bool = True) -> ProgressReporter:
    command = ReconstructionCommand(
        ring="spiked-none" if live else None,
        recording=None,
        folder=folder,
        can_block=False,
        options=ReconstructionOptions(),
        intrinsics=None,
    )
    return ProgressReporter(made, command, cast(WorkerChannel, told))


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Versions are written once this is set."""
    ready, publish = threading.Event(), Publisher.publish

    def late(self: Publisher, *given: Any) -> Any:
        assert ready.wait(60)
        return publish(self, *given)

    monkeypatch.setattr(Publisher, "publish", late)
    return ready


def test_a_live_tracker_does_not_wait_for_a_slow_disk(
    tracked: Reconstructor, tmp_path: Path, disk: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress_reporter, "_PUBLISH_S", 0.0)
    told = Told()
    reporter = reporter_of(tracked, tmp_path, told)
    for version in range(1, 4):  # returns each time, and begins no second one
        reporter.progress(replace(tracked.status(), version=version))
    assert told.versions == [] and not list(tmp_path.glob("scene-*"))
    statuses = [event for event in told.events if isinstance(event, ReconstructionStatus)]
    assert statuses and {status.version for status in statuses} == {0}
    disk.set()
    status = replace(tracked.status(), version=1)  # the one that was written: none is due
    until(lambda: (reporter.progress(status), told.versions == [1])[1], "the version is told")
    assert [file.name for file in tmp_path.glob("scene-*.ply")] == ["scene-000001.ply"]


def test_the_end_waits_for_the_version_that_is_being_written(
    tracked: Reconstructor, tmp_path: Path, disk: threading.Event
) -> None:
    told = Told()
    reporter = reporter_of(tracked, tmp_path, told)
    reporter.progress(tracked.status())
    threading.Timer(0.3, disk.set).start()
    reporter.frames_skipped(10)
    assert told.versions == [1, 2]


@pytest.mark.parametrize("end", [ProgressReporter.close, ProgressReporter.refine])
def test_a_version_that_finds_no_room_is_an_error_of_the_reconstruction(
    tracked: Reconstructor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: Callable[[ProgressReporter], None]
) -> None:
    def full(self: Publisher, *given: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Publisher, "publish", full)
    reporter = reporter_of(tracked, tmp_path, Told())
    with pytest.raises(SceneError, match="No space left on device; free disk space"):
        reporter.progress(tracked.status())
        end(reporter)


def test_a_recording_s_versions_are_written_in_their_place(tracked: Reconstructor, tmp_path: Path) -> None:
    told = Told()
    reporter_of(tracked, tmp_path, told, live=False).progress(tracked.status())
    assert told.versions == [1]
