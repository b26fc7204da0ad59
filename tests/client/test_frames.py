"""`Spiked.frames`: frames of a running capture, read by other programs that cannot disturb it."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import until

from spiked.client import CaptureState, FrameStream, Spiked
from spiked.errors import SpikedError
from spiked.recording import RecordingWriter, open_recording
from spiked.ring import ClockPair, EndReason, LossCause, RingError, RingWriter
from spiked.sensor import Sensor

SENSOR = Sensor(64, 8, 20_000.0)
EXAMPLE = Path(__file__).parents[2] / "examples" / "frames.py"
SLEEPER = """
import sys, time
from spiked.client import FrameStream
with FrameStream(sys.argv[1]) as stream:
    block = next(iter(stream))
    print(block.first, flush=True)
    time.sleep(600)
"""


def put(writer: RingWriter, frames: int = 8) -> None:
    """Commit a block whose frames hold their own number."""
    view = writer.acquire()
    view[:frames].view(np.int64)[:] = np.arange(writer.next_frame, writer.next_frame + frames)[:, None]
    writer.commit(frames)


def test_blocks_come_with_their_numbers_times_and_losses() -> None:
    with RingWriter.create(SENSOR, slots=16) as writer:
        stream = FrameStream(writer.name)
        put(writer)
        writer.gap(5, LossCause.USB)
        put(writer)
        writer.clock_pair(ClockPair(20, 1_000_000_000))
        put(writer, 3)
        writer.end(EndReason.FINISHED)
        blocks = []
        for block in stream:
            np.testing.assert_array_equal(block.data.view(np.int64)[:, 0], block.numbers)
            assert not block.data.flags.writeable and block.intact()
            assert block.spikes().shape == (len(block.data), 8, 64)
            blocks.append(block)
    assert [(one.first, len(one.data), one.lost) for one in blocks] == [(0, 8, 0), (13, 8, 5), (21, 3, 0)]
    assert blocks[0].unix_ns is None
    assert blocks[2].unix_ns is not None
    np.testing.assert_array_equal(blocks[2].unix_ns, 1_000_000_000 + 50_000 * np.arange(1, 4))
    assert (stream.lost, stream.end) == (5, EndReason.FINISHED)


def test_a_block_that_was_overwritten_while_it_was_used_says_so_and_counts_as_lost() -> None:
    with RingWriter.create(SENSOR, slots=16) as writer:
        stream = FrameStream(writer.name)
        put(writer)
        blocks = iter(stream)
        first = next(blocks)
        for _ in range(40):
            put(writer)
        assert not first.intact()
        later = next(blocks)
        assert later.intact() and later.lost == later.first and stream.lost == later.first


def test_a_block_says_that_it_was_overwritten_after_the_next_was_taken() -> None:
    with RingWriter.create(SENSOR, slots=16) as writer:
        stream = FrameStream(writer.name)
        put(writer)
        put(writer)
        blocks = iter(stream)
        first, _second = next(blocks), next(blocks)
        assert first.intact()
        for _ in range(40):
            put(writer)
        assert not first.intact()
        stream.close()
        assert not first.intact()


def test_a_block_that_was_intact_counts_as_read_only() -> None:
    with RingWriter.create(SENSOR, slots=16) as writer:
        stream = FrameStream(writer.name)
        put(writer)
        blocks = iter(stream)
        first = next(blocks)
        assert first.intact()
        for _ in range(40):
            put(writer)
        later = next(blocks)
        assert later.lost == stream.lost == later.first - 8
        assert not first.intact() and stream.lost == later.lost


def test_a_ring_that_is_not_here_is_refused() -> None:
    with pytest.raises(RingError, match="there is no ring spiked-nowhere"):
        FrameStream("spiked-nowhere")


def test_a_sleeping_and_a_killed_client_hold_no_recorder_back(daemon: Callable[..., Any], tmp_path: Path) -> None:
    content = np.random.default_rng(1).integers(0, 256, (2000, SENSOR.frame_bytes), np.uint8)
    with RecordingWriter(tmp_path / "noise.dat", SENSOR) as writer:
        writer.append(content)
    with Spiked(daemon().address) as service:
        plan = f"replay:{tmp_path / 'noise.dat'}?pace=0.25&repeat=100"
        capture = service.start_capture(plan, reconstruct=False)
        stream = service.frames(capture.id)
        clients = [
            subprocess.Popen([sys.executable, "-c", SLEEPER, service.capture(capture.id).ring], stdout=subprocess.PIPE)
            for _ in range(2)
        ]
        for client in clients:
            assert client.stdout is not None and client.stdout.readline()
            client.stdout.close()
        clients[0].kill()
        clients[0].wait()
        seen = 0
        for block in stream:
            copy = block.data.copy()
            if block.intact():
                np.testing.assert_array_equal(copy, content[block.numbers % 2000])
                seen += len(copy)
            if seen > 20_000:
                break
        until(lambda: service.capture(capture.id).counters.next_frame > 60_000, "frames come")  # type: ignore[union-attr]
        names = {one.name for one in service.capture(capture.id).counters.consumers}  # type: ignore[union-attr]
        service.stop_capture(capture.id)
        done = service.wait_for_capture(capture.id)
        assert clients[1].poll() is None
        clients[1].kill()
        clients[1].wait()
        assert names == {"recorder", "preview"}
        assert done.state is CaptureState.complete and done.ring is None
        assert done.recording is not None and done.recording.lost == 0
        recording = open_recording(service.save_recording(capture.id, tmp_path / "copy.dat"))
        assert recording.frames > 60_000
        for _ in stream:
            pass
        assert stream.end is EndReason.STOPPED
        with pytest.raises(SpikedError, match="is complete: frames can be read while it runs"):
            service.frames(capture.id)


def test_the_capture_event_has_the_name_of_the_ring(daemon: Callable[..., Any]) -> None:
    with Spiked(daemon().address) as service:
        capture = service.start_capture("sim:?width=64&height=48&pace=1", frames=4000, reconstruct=False)
        rings = []
        for event in service.events(topics=["capture"], since=0):
            rings.append(event.data["ring"])
            if event.data["state"] == "complete":
                break
    assert f"spiked-{capture.id}" in rings and rings[-1] is None


def test_the_example_reads_a_capture_to_its_end(daemon: Callable[..., Any]) -> None:
    code = [line for line in EXAMPLE.read_text().split('"""')[2].splitlines() if line.strip()]
    assert len(code) <= 20
    one = daemon()
    with Spiked(one.address) as service:
        capture = service.start_capture("sim:?width=64&height=48&pace=1", seconds=4, reconstruct=False)
        command = [sys.executable, str(EXAMPLE), one.address, capture.id]
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        *blocks, last = done.stdout.splitlines()
        assert blocks[0].startswith("frames ") and last.startswith("finished: ")
        read, lost = (int(word) for word in last.split() if word.isdigit())
        first = int(blocks[0].split()[1])
        assert first + read + lost == 80_000 and read > 0
