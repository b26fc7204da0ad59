"""Jobs that use maps: a recording localised in one, one extended by a recording, two merged."""

import json
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from spiked_service.base.errors import BusyError
from spiked_service.captures.archive import DataStore
from spiked_service.results.map_reports import LOCALISATION, REGISTRATION
from spiked_service.results.report.job import JobReport
from spiked_service.results.report.page import report_html
from spiked_service.results.versions import newest, pose_file, versions
from spiked_service.settings.reconstruction_options import IntrinsicsOption, ReconstructionOptions
from spiked_service.store.catalogue import UnknownIdError
from spiked_service.store.rows import FrameRange, JobState, Plan, ReconstructionRow, Stage, Task
from waiting import until

from spiked.errors import ConfigurationError
from spiked.poses import PoseFile
from spiked.recording import RecordingWriter
from spiked.trajectory import Trajectory

from ..published_map import published_map
from ..room_map import GAIN, OPTICS, SENSOR, room_map, visitor
from .survival import ended, kept, over

FRAMES = 300
LEFT, RIGHT = (0.0, 0.5), (0.45, 0.95)
"""Where the cameras of two maps of a room look; they overlap."""
LONG = ReconstructionOptions(steps=200_000)


@dataclass(frozen=True)
class Place:
    """A service with recordings of two rooms, and maps of them."""

    data_store: DataStore
    again: str
    """Capture of room 2."""
    other: str
    """Capture of room 3."""
    maps: dict[str, str]
    """Reconstructions by name."""

    def submit(self, capture_id: str, task: Task, *map_ids: str, part: FrameRange | None = None) -> ReconstructionRow:
        jobs = self.data_store.reconstructions
        return jobs.submit(capture_id, ReconstructionOptions(steps=20), task=task, map_ids=map_ids, part=part)

    def done(self, capture_id: str, task: Task, *map_ids: str, part: FrameRange | None = None) -> ReconstructionRow:
        return ended(self.data_store, self.submit(capture_id, task, *map_ids, part=part))

    def folder(self, row: ReconstructionRow) -> Path:
        return self.data_store.reconstructions.rows.folder(row.id)

    def path(self, row: ReconstructionRow) -> Trajectory:
        published = newest(self.folder(row))
        assert published is not None
        file = PoseFile(pose_file(self.folder(row), published))
        return file.trajectory(range(len(file)))

    def report(self, row: ReconstructionRow, name: str) -> dict[str, object]:
        return dict(json.loads((self.folder(row) / name).read_text()))

    def document(self, row: ReconstructionRow) -> dict[str, Any]:
        """The figures of the report of a job, once its page can be made."""
        folder, published = self.folder(row), newest(self.folder(row))
        assert published is not None
        source = JobReport(
            row=row,
            capture=self.data_store.captures.get(row.capture_id).row,
            folder=folder,
            published=published,
            poses=PoseFile(pose_file(folder, published)),
            sensor=SENSOR,
            timeline=self.data_store.reconstructions.rows.timeline(row.id),
            recording=self.data_store.folder.recording(row.capture_id),
            render=None,
        ).read()
        assert row.id in report_html(source)
        return dict(source.document)


def recorded(data_store: DataStore, folder: Path, seed: int, frames: int = FRAMES, flow_px: float = 0.05) -> str:
    """The id of a capture of a visit to a room."""
    path = folder / f"{seed}-{frames}.dat"
    with RecordingWriter(path, SENSOR) as writer:
        writer.append(visitor(seed, flow_px=flow_px).next_frames(frames))
    plan = Plan(f"replay:{path}?pace=0", reconstruct=False)
    return over(data_store, data_store.captures.start(plan).id).id


def mapped(data_store: DataStore, capture_id: str, seed: int, turns_rad: tuple[float, ...] = (0.0, 0.4, 0.8)) -> str:
    """The id of a complete reconstruction that shows a room."""
    made = room_map(seed, turns_rad)
    return published_map(data_store, capture_id, made.scene, made.path, OPTICS, GAIN)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder = tmp_path_factory.mktemp("place")
    with kept(folder / "data") as data_store:
        again, other = recorded(data_store, folder, 2), recorded(data_store, folder, 3)
        maps = {
            "room": mapped(data_store, again, 2),
            "left": mapped(data_store, again, 2, LEFT),
            "right": mapped(data_store, other, 2, RIGHT),
            "other": mapped(data_store, other, 3),
        }
        yield Place(data_store, again, other, maps)


def test_a_recording_is_localised_in_a_map(place: Place) -> None:
    job = place.submit(place.again, Task.LOCALISE, place.maps["room"])
    assert (job.task, job.maps[0].version, job.recognised) == (Task.LOCALISE, 1, None)
    row = ended(place.data_store, job)
    assert (row.state, row.reason, row.recognised, row.frames) == (JobState.COMPLETE, "", True, FRAMES)
    path = place.path(row)
    _, centres = visitor(2).truth(path.times_s * SENSOR.frame_rate_hz - 0.5)
    assert np.linalg.norm(path.centres - centres, axis=1).max() < 0.03
    found = place.report(row, LOCALISATION)
    assert found["recognised"] and len(found["views"]) == len(path) == row.poses > 5  # type: ignore[arg-type]
    document = place.document(row)
    assert document["localisation"]["recognised"] and document["job"]["task"] == "localise"
    assert row.splats == len(room_map(2).scene) and not list(place.folder(row).glob("map-*"))


def test_a_part_of_a_recording_is_localised(place: Place) -> None:
    row = place.done(place.again, Task.LOCALISE, place.maps["room"], part=FrameRange(100, 150))
    assert (row.state, row.frames) == (JobState.COMPLETE, 150)
    frames = place.path(row).times_s * SENSOR.frame_rate_hz
    assert 100 < frames[0] < frames[-1] < 250
    beyond = place.done(place.again, Task.LOCALISE, place.maps["room"], part=FrameRange(FRAMES, 10))
    assert beyond.state is JobState.FAILED and "none of the frames to localise are recorded" in beyond.reason


def test_another_room_is_not_recognised(place: Place) -> None:
    row = place.done(place.other, Task.LOCALISE, place.maps["room"])
    assert (row.state, row.recognised, row.version) == (JobState.FAILED, False, 0)
    assert row.reason.startswith("not recognised: ")
    assert place.report(row, LOCALISATION)["reason"] == row.reason


def test_two_maps_are_merged_into_one_of_the_first_capture(place: Place) -> None:
    left, right = place.maps["left"], place.maps["right"]
    row = place.done(place.again, Task.MERGE, left, right)
    assert (row.state, row.reason, row.recognised, row.capture_id) == (JobState.COMPLETE, "", True, place.again)
    assert np.allclose(place.path(row).centres, room_map(2, LEFT).path.centres)
    published = newest(place.folder(row))
    assert published is not None and [one.capture_id for one in published.paths] == [place.other]
    document = place.document(row)
    assert document["merged"] and [one["name"] for one in document["paths"]] == [place.other]
    file = PoseFile(place.folder(row) / published.paths[0].trajectory)
    moved = file.trajectory(range(len(file)))
    assert np.linalg.norm(moved.centres - room_map(2, RIGHT).path.centres, axis=1).max() < 0.03
    found = place.report(row, REGISTRATION)
    assert found["joined"] and found["similarity"]["scale"] == pytest.approx(1, rel=0.01)  # type: ignore[index]
    again = place.done(place.again, Task.LOCALISE, row.id, part=FrameRange(0, 200))
    assert again.recognised, "what was merged is a map"
    twice = place.done(place.again, Task.MERGE, row.id, place.maps["room"])
    published = newest(place.folder(twice))
    assert twice.recognised and published is not None
    assert [one.capture_id for one in published.paths] == [place.other, place.again]
    for one in (row, again, twice):
        place.data_store.reconstructions.remove(one.id)


def test_maps_of_two_places_are_not_merged_and_stay(place: Place) -> None:
    before = {name: versions(place.data_store.folder.reconstruction(one)) for name, one in place.maps.items()}
    row = place.done(place.again, Task.MERGE, place.maps["left"], place.maps["other"])
    assert (row.state, row.recognised, row.version) == (JobState.FAILED, False, 0)
    assert row.reason.startswith("these two do not show the same place: ")
    assert place.report(row, REGISTRATION) == {"joined": False, "reason": row.reason}
    assert before == {name: versions(place.data_store.folder.reconstruction(one)) for name, one in place.maps.items()}


@pytest.mark.slow
def test_a_map_is_extended_by_a_recording(place: Place, tmp_path: Path) -> None:
    capture_id = recorded(place.data_store, tmp_path, 2, 1200, 0.1)
    row = place.done(capture_id, Task.EXTEND, place.maps["room"])
    assert (row.state, row.reason, row.recognised, row.stage) == (JobState.COMPLETE, "", True, Stage.DONE)
    path = place.path(row)
    _, centres = visitor(2, flow_px=0.1).truth(path.times_s * SENSOR.frame_rate_hz - 0.5)
    assert np.linalg.norm(path.centres - centres, axis=1).max() < 0.05, "in the map's frame and unit"
    published = newest(place.folder(row))
    assert published is not None and [one.capture_id for one in published.paths] == [place.again]
    assert place.report(row, REGISTRATION)["joined"]
    assert not place.data_store.folder.checkpoint(row.id).exists()


@pytest.mark.slow
def test_a_map_of_another_room_is_not_extended_and_the_recording_alone_is_kept(place: Place, tmp_path: Path) -> None:
    capture_id = recorded(place.data_store, tmp_path, 2, 1200, 0.1)
    row = place.done(capture_id, Task.EXTEND, place.maps["other"])
    assert (row.state, row.recognised) == (JobState.FAILED, False) and row.version > 0
    assert row.reason.startswith(f"the map {place.maps['other']} was not extended: these two do not show the same")
    assert row.reason.endswith("the versions show the recording alone")
    published = newest(place.folder(row))
    assert published is not None and published.paths == []


@pytest.mark.parametrize("task", [Task.LOCALISE, Task.MERGE])
def test_a_job_whose_worker_is_killed_is_begun_again(place: Place, task: Task) -> None:
    data_store = place.data_store
    maps = [place.maps["left"], place.maps["right"]] if task is Task.MERGE else [place.maps["room"]]
    job = place.submit(place.again, task, *maps)
    until(lambda: job.id in data_store.reconstructions.processes(), "it runs")
    os.kill(data_store.reconstructions.processes()[job.id], signal.SIGKILL)
    until(lambda: data_store.reconstructions.rows.get(job.id).state is JobState.QUEUED, "it is queued again")
    reason = data_store.reconstructions.rows.get(job.id).reason
    assert reason.endswith("; restarted (attempt 2)" if task is Task.MERGE else "from the recording (attempt 2)")
    row = ended(data_store, job)
    assert (row.state, row.attempts, row.recognised) == (JobState.COMPLETE, 2, True)


@pytest.mark.slow
def test_an_extension_whose_worker_is_killed_while_it_joins_goes_on(place: Place, tmp_path: Path) -> None:
    data_store = place.data_store
    capture_id = recorded(data_store, tmp_path, 2, 1200, 0.1)
    job = place.submit(capture_id, Task.EXTEND, place.maps["room"])
    until(lambda: data_store.reconstructions.rows.get(job.id).stage is Stage.JOINING, "it joins")
    os.kill(data_store.reconstructions.processes()[job.id], signal.SIGKILL)
    row = ended(data_store, job)
    assert (row.state, row.attempts, row.recognised) == (JobState.COMPLETE, 2, True)
    log = data_store.reconstructions.rows.log(job.id).read_text()
    assert "resumed from its checkpoint: done" in log, "neither tracking nor refinement is repeated"


def test_inputs_that_go_while_a_job_waits_do_not_harm_it(place: Place) -> None:
    data_store = place.data_store
    blocking = data_store.reconstructions.submit(place.again, LONG)
    passing = mapped(data_store, place.other, 2)
    job = place.submit(place.again, Task.LOCALISE, passing)
    data_store.reconstructions.remove(passing)
    assert not data_store.folder.reconstruction(passing).exists()
    data_store.reconstructions.cancel(blocking.id)
    row = ended(data_store, job)
    assert (row.state, row.recognised, row.maps[0].reconstruction_id) == (JobState.COMPLETE, True, passing)
    with pytest.raises(UnknownIdError, match=passing):
        data_store.reconstructions.restart(row.id)
    assert data_store.reconstructions.rows.get(row.id) == row


def test_a_cancelled_job_lets_go_of_its_maps(place: Place) -> None:
    data_store = place.data_store
    blocking = data_store.reconstructions.submit(place.again, LONG)
    waiting = place.submit(place.again, Task.LOCALISE, place.maps["room"])
    assert (place.folder(waiting) / "map-1" / "scene.ply").exists()
    data_store.reconstructions.cancel(waiting.id)
    assert not list(place.folder(waiting).glob("map-*"))
    data_store.reconstructions.cancel(blocking.id)
    ended(data_store, blocking)
    running = place.submit(place.again, Task.MERGE, place.maps["left"], place.maps["right"])
    until(lambda: running.id in data_store.reconstructions.processes(), "it runs")
    data_store.reconstructions.cancel(running.id)
    row = ended(data_store, running)
    assert (row.state, row.version) == (JobState.CANCELLED, 0)
    assert ended(data_store, data_store.reconstructions.restart(row.id)).recognised


def test_what_cannot_be_done_is_refused_at_once(place: Place, tmp_path: Path) -> None:
    data_store, room = place.data_store, place.maps["room"]
    before = set(data_store.folder.contents()[1])
    with pytest.raises(UnknownIdError):
        place.submit(place.again, Task.LOCALISE, "nothing")
    with pytest.raises(UnknownIdError):
        place.submit("nothing", Task.LOCALISE, room)
    with pytest.raises(ConfigurationError, match="merged with itself"):
        place.submit(place.again, Task.MERGE, room, room)
    found = place.done(place.again, Task.LOCALISE, room, part=FrameRange(0, 200))
    with pytest.raises(ConfigurationError, match=f"is a localisation and no map: use its map {room}"):
        place.submit(place.again, Task.LOCALISE, found.id)
    data_store.reconstructions.remove(found.id)
    empty = data_store.reconstructions.submit(place.again, LONG)
    with pytest.raises(BusyError, match="wait for its end"):
        place.submit(place.again, Task.EXTEND, empty.id)
    data_store.reconstructions.cancel(empty.id)
    ended(data_store, empty)
    data_store.reconstructions.remove(empty.id)
    bare = replace(SENSOR, width=320, intrinsics=None)
    with RecordingWriter(tmp_path / "wide.dat", bare) as writer:
        writer.append(np.zeros((FRAMES, bare.frame_bytes), np.uint8))
    plan = Plan(f"replay:{tmp_path / 'wide.dat'}?pace=0", reconstruct=False)
    wide = over(data_store, data_store.captures.start(plan).id).id
    with pytest.raises(ConfigurationError, match="320x160 and the map was made with 240x160"):
        place.submit(wide, Task.LOCALISE, room)
    lens = ReconstructionOptions(intrinsics=IntrinsicsOption(fx=200, fy=200, cx=160, cy=80))
    dark = data_store.reconstructions.submit(wide, lens, task=Task.LOCALISE, map_ids=(room,))
    assert "too little texture or light" in ended(data_store, dark).reason
    data_store.reconstructions.remove(dark.id)
    data_store.captures.removal.remove(wide)
    with pytest.raises(ConfigurationError, match="is deleted"):
        place.submit(wide, Task.LOCALISE, room)
    assert set(data_store.folder.contents()[1]) == before, "nothing is left of what was refused"


@pytest.mark.slow
def test_jobs_of_a_service_that_ends_are_carried_out_by_the_next(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with kept(data) as data_store:
        capture_id = recorded(data_store, tmp_path, 2)
        room = mapped(data_store, capture_id, 2)
        data_store.reconstructions.submit(capture_id, LONG)
        job = data_store.reconstructions.submit(capture_id, priority=1, task=Task.LOCALISE, map_ids=(room,))
        data_store.reconstructions.remove(room)
    for suffix in ("", "-wal", "-shm"):
        (data / f"catalogue.sqlite{suffix}").unlink(missing_ok=True)
    with kept(data) as data_store:
        row = ended(data_store, job)
        assert (row.state, row.recognised, row.task) == (JobState.COMPLETE, True, Task.LOCALISE)
        assert versions(data_store.folder.reconstruction(row.id))


def test_maps_are_copied_where_files_cannot_have_two_names(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(PermissionError(1, "not here")))
    row = place.done(place.again, Task.LOCALISE, place.maps["room"], part=FrameRange(0, 200))
    assert row.recognised
