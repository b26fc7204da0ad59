"""Checkpoints: what is resumed ends as if it had never been interrupted, and what is damaged is told."""

import json
import pickle
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from spiked_service.results.recording_feed import reconstruct_recording

from spiked.errors import CheckpointError
from spiked.recon import MethodName, Options, Reconstructor, checkpoint, checkpoint_file
from spiked.recon.checkpoint import CheckpointSaver, Interrupted
from spiked.recording import Recording, RecordingWriter, open_recording
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

SENSOR = Sensor(160, 104, 20_000.0, intrinsics=Intrinsics.from_fov(160, 104, 60))
FRAMES, GAP_FIRST, GAP_FRAMES = 640, 330, 12
STEPS = 30


class KilledError(Exception):
    """The end of a process, as seen from within."""


def recorded(path: Path, seed: int = 3, flow_px: float = 0.25) -> Recording:
    """A recording of the built-in room with a gap."""
    camera = SimulatedCamera(SENSOR, seed=seed, motion=MotionKind.ARC, flow_px=flow_px, parallax=0.5)
    frames = camera.next_frames(FRAMES)
    with RecordingWriter(path, SENSOR) as writer:
        writer.append(frames[:GAP_FIRST])
        writer.gap(GAP_FIRST, GAP_FRAMES, "usb")
        writer.append(frames[GAP_FIRST + GAP_FRAMES :])
    return open_recording(path)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return recorded(tmp_path_factory.mktemp("room") / "room.dat")


def run(recording: Recording, reconstructor: Reconstructor, save: Callable[[], None] = lambda: None) -> None:
    reconstruct_recording(recording, reconstructor, progress=lambda status: None, cancelled=lambda: False, save=save)


def arrays(reconstructor: Reconstructor) -> list[np.ndarray]:
    path = reconstructor.trajectory()
    return [path.times_s, path.rotations, path.centres, *reconstructor.scene().arrays()]


@pytest.fixture(scope="module")
def whole(room: Recording) -> Reconstructor:
    """A run that nothing interrupts."""
    reconstructor = Reconstructor(room.sensor, Options(steps=STEPS), recording=room)
    run(room, reconstructor)
    assert reconstructor.failure is None
    return reconstructor


def interrupted(
    recording: Recording,
    folder: Path,
    where: Callable[[Reconstructor], bool],
    saver: CheckpointSaver | None = None,
    options: Options | None = None,
) -> None:
    """Run to the first place for which `where` is true, leave a checkpoint there, and end."""
    reconstructor = Reconstructor(recording.sensor, options or Options(steps=STEPS), recording=recording)
    saver = saver or CheckpointSaver(folder, recording, {"steps": STEPS}, pytest.fail)

    def save() -> None:
        if where(reconstructor):
            saver.save(reconstructor, now=True)
            saver.close()
            raise KilledError

    with pytest.raises(KilledError):
        run(recording, reconstructor, save)


def refined(share: float) -> Callable[[Reconstructor], bool]:
    return lambda one: (
        one.tracking_ended and one.status().stage == "refining" and one.work_s > 0 and steps(one) >= share
    )


def steps(reconstructor: Reconstructor) -> float:
    """Share of the steps of the refinement."""
    done = reconstructor.report()["steps"]
    assert isinstance(done, int)
    return done / STEPS


PLACES: dict[str, Callable[[Reconstructor], bool]] = {
    "the first frames": lambda one: one.frames > 0,
    "tracking, before the gap": lambda one: one.frames >= 192,
    "tracking, behind the gap": lambda one: one.frames > GAP_FIRST + GAP_FRAMES,
    "the end of the tracking": lambda one: one.tracking_ended,
    "the first step": refined(0),
    "between two alignments": refined(0.4),
    "the last steps": refined(0.95),
}
FAST = "tracking, behind the gap", "between two alignments"
"""Places of the fast suite."""


@pytest.mark.parametrize("place", [pytest.param(p, marks=() if p in FAST else pytest.mark.slow) for p in PLACES])
def test_a_resumed_run_ends_with_the_same_bits(
    room: Recording, whole: Reconstructor, tmp_path: Path, place: str
) -> None:
    interrupted(room, tmp_path / "checkpoint", PLACES[place])
    found = Interrupted.read(tmp_path / "checkpoint")
    assert found.parameters == {"steps": STEPS}
    assert found.recording == room.path
    resumed = found.resume(room)
    run(room, resumed)
    for mine, theirs in zip(arrays(resumed), arrays(whole), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert [view["state"] for view in views(resumed)] == [view["state"] for view in views(whole)]


def views(reconstructor: Reconstructor) -> list[dict[str, Any]]:
    found = reconstructor.report()["views"]
    assert isinstance(found, list)
    return found


@pytest.mark.parametrize("most", [12, 45], ids=["while views are added", "between pose steps and scene steps"])
def test_the_method_of_the_paper_is_resumed_with_the_same_bits(room: Recording, tmp_path: Path, most: int) -> None:
    """A checkpoint is a position in its list of actions, with the running means of its pose gradient."""
    options = Options(steps=100, method=MethodName.NOPE_SGS, window_frames=32)
    alone = Reconstructor(room.sensor, options, recording=room)
    run(room, alone)
    interrupted(room, tmp_path / "checkpoint", lambda one: one.trainer.mapper.steps >= most, options=options)
    resumed = Interrupted.read(tmp_path / "checkpoint").resume(room)
    assert most <= resumed.trainer.mapper.steps < alone.trainer.mapper.steps
    run(room, resumed)
    for mine, theirs in zip(arrays(resumed), arrays(alone), strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.slow
def test_fast_motion_is_resumed_with_the_same_bits(tmp_path: Path) -> None:
    recording = recorded(tmp_path / "fast.dat", flow_px=0.8)
    alone = Reconstructor(recording.sensor, Options(steps=STEPS), recording=recording)
    run(recording, alone)
    interrupted(recording, tmp_path / "checkpoint", lambda one: one.frames >= 256)
    resumed = Interrupted.read(tmp_path / "checkpoint").resume(recording)
    assert any(resumed.views[i].frames.warped is not None for i in resumed.views.kept)
    run(recording, resumed)
    for mine, theirs in zip(arrays(resumed), arrays(alone), strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.slow
def test_a_run_is_resumed_again_and_again(room: Recording, whole: Reconstructor, tmp_path: Path) -> None:
    folder, reconstructor = tmp_path / "checkpoint", Reconstructor(room.sensor, Options(steps=STEPS), recording=room)
    for number in range(3):
        saver = CheckpointSaver(folder, room, {}, pytest.fail)
        calls = 0

        def save(
            saver: CheckpointSaver = saver, one: Reconstructor = reconstructor, last: int = number * 7 + 3
        ) -> None:
            nonlocal calls
            calls += 1
            saver.save(one, now=True)
            if calls == last:
                saver.close()
                raise KilledError

        with pytest.raises(KilledError):
            run(room, reconstructor, save)
        reconstructor = Interrupted.read(folder).resume(room)
    run(room, reconstructor)
    for mine, theirs in zip(arrays(reconstructor), arrays(whole), strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.fixture
def left(room: Recording, tmp_path: Path) -> Path:
    """The folder of a checkpoint of the tracking."""
    interrupted(room, tmp_path / "checkpoint", PLACES["tracking, before the gap"])
    return tmp_path / "checkpoint"


def told(folder: Path, recording: Recording) -> str:
    with pytest.raises(CheckpointError) as error:
        Interrupted.read(folder).resume(recording)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_no_checkpoint_is_told(room: Recording, tmp_path: Path) -> None:
    assert "there is no checkpoint" in told(tmp_path, room)


def test_another_recording_is_told(left: Path, tmp_path: Path) -> None:
    assert "they differ in content" in told(left, recorded(tmp_path / "other.dat", seed=4))


def test_a_recording_that_moved_is_the_same(left: Path, room: Recording, tmp_path: Path) -> None:
    for suffix in (".dat", ".json"):
        (tmp_path / "moved").with_suffix(suffix).write_bytes(room.path.with_suffix(suffix).read_bytes())
    assert Interrupted.read(left).resume(open_recording(tmp_path / "moved.dat")).frames > 0


def test_another_build_is_told(left: Path, room: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "_program", lambda: {"spiked": "another"})
    assert "another build of spiked" in told(left, room)


def test_another_format_is_told(left: Path, room: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint_file, "FORMAT", 2)
    assert "format 1, and this program reads 2" in told(left, room)


@pytest.mark.parametrize("name", ["state", "arrays-1"])
def test_damage_is_told(left: Path, room: Recording, name: str) -> None:
    whole = (left / name).read_bytes()
    rng = np.random.default_rng(0)
    damaged = [whole[: int(end)] for end in rng.integers(0, len(whole), 8)] + [b"", b"garbage", bytes(len(whole))]
    for at in rng.integers(0, len(whole), 24).tolist():
        damaged.append(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    for content in damaged:
        (left / name).write_bytes(content)
        assert "damaged" in told(left, room)
    (left / name).unlink()
    told(left, room)


def test_code_in_a_checkpoint_is_not_executed(left: Path, room: Recording, tmp_path: Path) -> None:
    class Attack:
        def __reduce__(self) -> tuple[Any, tuple[str, str]]:
            return Path.write_text, (tmp_path / "attacked", "")  # type: ignore[return-value]

    header = Interrupted.read(left).state.header
    folder = checkpoint_file.CheckpointFolder(left)
    for attack in (Attack(), subprocess.run, RecordingWriter):
        payload = pickle.dumps((attack,))
        folder.write(header | {"tracking": len(payload)}, payload + payload, [])
        assert "is no state of a reconstruction" in told(left, room)
    assert not (tmp_path / "attacked").exists()


def test_two_processes_do_not_write_one_checkpoint(left: Path, room: Recording) -> None:
    saver = CheckpointSaver(left, room, {}, pytest.fail)
    with pytest.raises(CheckpointError, match="another process works there"):
        CheckpointSaver(left, room, {}, pytest.fail)
    saver.close()


def test_a_full_disk_is_told_once_and_the_run_goes_on(room: Recording, whole: Reconstructor, tmp_path: Path) -> None:
    warnings: list[str] = []
    folder, reconstructor = tmp_path / "checkpoint", Reconstructor(room.sensor, Options(steps=STEPS), recording=room)
    saver = CheckpointSaver(folder, room, {}, warnings.append)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        calls = 0

        def save() -> None:
            nonlocal calls
            calls += 1
            if calls == 5:
                resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
            if calls == 30:
                resource.setrlimit(resource.RLIMIT_FSIZE, before)
            saver.save(reconstructor, now=True)
            if 5 < calls < 30:
                assert Interrupted.read(folder).state.header["frames"] <= 256
            if calls == 32:
                saver.close()
                raise KilledError

        with pytest.raises(KilledError):
            run(room, reconstructor, save)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert len(warnings) == 1
    assert "no checkpoint can be written" in warnings[0]
    resumed = Interrupted.read(folder).resume(room)
    run(room, resumed)
    for mine, theirs in zip(arrays(resumed), arrays(whole), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_checkpoints_are_some_seconds_apart_and_go_at_the_end(room: Recording, tmp_path: Path) -> None:
    folder, reconstructor = tmp_path / "checkpoint", Reconstructor(room.sensor, Options(steps=0), recording=room)
    saver = CheckpointSaver(folder, room, {}, pytest.fail)
    assert not saver.due
    saver.save(reconstructor)
    assert saver.saved == 0
    saver.save(reconstructor, now=True)
    assert saver.saved == 1
    assert checkpoint_file.exists(folder)
    saver.remove()
    assert not folder.exists()


_WRITES = """
import sys
from pathlib import Path
import numpy as np
from spiked.recon.checkpoint_file import CheckpointFolder
folder = CheckpointFolder(Path(sys.argv[1]))
for number in range(1_000_000):
    if number % 50 == 49:
        folder.begin_arrays()
    begin = folder.arrays_bytes
    folder.write({"number": number, "begin": begin}, bytes([number % 256]) * 100_000, [np.full(1000, number)])
"""


def test_a_kill_at_any_moment_leaves_a_whole_checkpoint(tmp_path: Path) -> None:
    rng, numbers = np.random.default_rng(0), []
    for _ in range(6):
        with subprocess.Popen([sys.executable, "-c", _WRITES, str(tmp_path)]) as process:
            deadline = time.monotonic() + 30
            while not (tmp_path / "state").exists() and time.monotonic() < deadline:
                time.sleep(0.01)
            time.sleep(float(rng.uniform(0.02, 0.3)))
            process.send_signal(signal.SIGKILL)
        state = checkpoint_file.read(tmp_path)
        number = state.header["number"]
        assert state.payload == bytes([number % 256]) * 100_000
        place = checkpoint_file.Place(state.header["begin"], np.dtype(int).str, (1000,))
        np.testing.assert_array_equal(state.array(place), np.full(1000, number))
        numbers.append(number)
    assert max(numbers) > 0
    assert json.dumps(state.header)


def test_a_copy_of_a_checkpoint_that_is_being_written_is_whole(tmp_path: Path) -> None:
    assert not checkpoint_file.copy_newest(tmp_path / "there", tmp_path / "copy")
    over = threading.Event()
    written = 0

    def write() -> None:
        nonlocal written
        folder = checkpoint_file.CheckpointFolder(tmp_path / "there")
        while not over.is_set():
            if written % 5 == 0:
                folder.begin_arrays()  # and the file before is removed
            folder.write({"number": written}, bytes(100), [np.full(10_000, written)])
            written += 1
        folder.close()

    writer = threading.Thread(target=write)
    writer.start()
    numbers = set()
    while len(numbers) < 20:
        if checkpoint_file.copy_newest(tmp_path / "there", tmp_path / "copy"):
            numbers.add(checkpoint_file.read(tmp_path / "copy").header["number"])
    over.set()
    writer.join()
    names = [path.name for path in checkpoint_file.files_of(tmp_path / "copy")]
    assert len(names) == 2 and names[-1] == "state", "the state comes last"
