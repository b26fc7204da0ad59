"""A sustained stream: one process fills a ring at camera rate; others record, preview and make windows."""

import multiprocessing
import os
import tempfile
import threading
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from spiked.blocks import aligned_window
from spiked.errors import RecordingError
from spiked.measurement import Measurement
from spiked.recording import LIVE, RecordingWriter
from spiked.ring import End, EndReason, Frames, Gap, Policy, RingError, RingReader, RingWriter
from spiked.sensor import Sensor
from spiked_service.workers.roles.recorder import record

_START_S = 30.0
"""Time for the consumers to attach, seconds."""
_PREVIEW_S = 1 / 30
"""Pause of the preview between images, seconds."""
_WINDOW_FRAMES = 40
"""Frames of a spike-aligned window."""


@dataclass(frozen=True)
class Outcome:
    """Result of a run."""

    frames: int
    lost: dict[str, int]
    """Frames that each lossless consumer lost."""
    behind_s: float
    """Largest delay of the producer behind the camera clock."""
    producer_share: float
    """Of one core, used by the process that fills the ring."""
    consumer_shares: dict[str, float]


def run(sensor: Sensor, seconds: float, *, record: Path | None, preview: bool = True, block_frames: int = 8) -> Outcome:
    """Stream for that long; with `record`, into a file in that folder. Raises RingError if a process fails."""
    context = multiprocessing.get_context("spawn")
    kinds = ["windows"] + ["preview"] * preview + ["recorder"] * (record is not None)
    compact = sensor.compact()
    ring = RingWriter.create(compact, block_frames=block_frames)
    pipes: dict[str, Connection] = {}
    with tempfile.TemporaryDirectory(dir=record) as folder, ring as writer:
        processes = []
        for kind in kinds:
            ours, theirs = context.Pipe()
            process = context.Process(target=_consume, args=(kind, writer.name, folder, theirs))
            process.start()
            processes.append(process)
            pipes[kind] = ours
        try:
            if not writer.wait_for_readers(len(kinds), _START_S):
                raise RingError(f"the consumers did not attach to {writer.name} within {_START_S:g} s")
            frames, behind_s, share = _produce(writer, sensor, seconds)
            writer.end(EndReason.FINISHED)
            answers = {kind: pipe.recv() if pipe.poll(60) else None for kind, pipe in pipes.items()}
        finally:
            for process in processes:
                process.join(10)
                if process.is_alive():
                    process.terminate()
    failed = [kind for kind, answer in answers.items() if answer is None]
    if failed:
        raise RingError(f"{', '.join(failed)} did not end; the output says why")
    lost = {kind: answer[0] for kind, answer in answers.items() if answer and kind != "preview"}
    return Outcome(frames, lost, behind_s, share, {kind: answer[1] for kind, answer in answers.items() if answer})


def _produce(writer: RingWriter, sensor: Sensor, seconds: float) -> tuple[int, float, float]:
    """Frames, the longest delay in seconds, and the share of a core."""
    size = writer.geometry.block_frames
    frame_bytes = writer.geometry.sensor.frame_bytes
    memory = np.random.default_rng(0).integers(0, 256, (32, size, frame_bytes), np.uint8)
    blocks = int(seconds * sensor.frame_rate_hz / size)
    behind_s = 0.0
    cpu_s, start_s = time.process_time(), time.perf_counter()
    for k in range(blocks):
        due_s = start_s + (k + 1) * size / sensor.frame_rate_hz
        wait_s = due_s - time.perf_counter()
        if wait_s > 0:
            time.sleep(wait_s)
        else:
            behind_s = max(behind_s, -wait_s)
        writer.acquire()[:] = memory[k % len(memory)]
        writer.commit(size)
    elapsed_s = time.perf_counter() - start_s
    return blocks * size, behind_s, (time.process_time() - cpu_s) / elapsed_s


def _consume(kind: str, name: str, folder: str, answer: Connection) -> None:
    policy = {"preview": Policy.LATEST, "recorder": Policy.PRIORITY}.get(kind, Policy.LOSSLESS)
    with RingReader.attach(name, policy, kind) as reader:
        cpu_s, start_s = time.process_time(), time.perf_counter()
        if kind == "recorder":
            writer = RecordingWriter(Path(folder) / "bench.dat", reader.geometry.sensor, durability=LIVE)
            ended = record(reader, writer, 0, None, threading.Event())
            if ended.trouble:
                raise RecordingError(ended.trouble)
            lost = sum(ended.lost.values())
        else:
            lost = _windows(reader, pause_s=_PREVIEW_S if kind == "preview" else 0.0)
        answer.send((lost, (time.process_time() - cpu_s) / (time.perf_counter() - start_s)))


def _windows(reader: RingReader, pause_s: float) -> int:
    """Copies frames and makes a spike-aligned window of each `_WINDOW_FRAMES` until the end; frames that were lost."""
    lost = held = 0
    sensor = reader.geometry.sensor
    frames = np.zeros((_WINDOW_FRAMES, sensor.frame_bytes), np.uint8)
    out = None
    while not isinstance(item := reader.next(1.0), End):
        if isinstance(item, Gap):
            lost += item.count
        if isinstance(item, Frames):
            taken = min(len(item.data), _WINDOW_FRAMES - held)
            frames[held : held + taken] = item.data[:taken]
            held += taken
            if not item.release():
                lost += item.count
            if held == _WINDOW_FRAMES:
                out = aligned_window(frames, sensor, 0, 0, held, out=out)
                held = 0
                if pause_s:
                    time.sleep(pause_s)
    return lost


def rows(seconds: float, folder: Path | None = None) -> list[Measurement]:
    """The small camera with three consumers, then the large one: frames from memory, through the ring, to windows."""
    small = run(Sensor(400, 250, 20_000.0), seconds, record=folder or Path(tempfile.gettempdir()))
    large = run(Sensor(1000, 1000, 20_000.0), seconds / 6, record=None, preview=False)
    found = []
    for name, sensor, outcome in (
        ("400x250, 3 consumers", (400, 250), small),
        ("1000x1000, windows", (1000, 1000), large),
    ):
        rate = sensor[0] * sensor[1] / 8 * 20_000 * 1e-6
        length = outcome.frames / 20_000
        lost = ", ".join(f"{kind} lost {count}" for kind, count in outcome.lost.items())
        shares = ", ".join(f"{kind} {share:.2f}" for kind, share in outcome.consumer_shares.items())
        found.append(
            Measurement(
                f"ring, {name}, {rate:.0f} MB/s for {length:.0f} s: lost",
                sum(outcome.lost.values()),
                "frames",
                outcome.producer_share,
                f"of a core to fill it; {lost}; cores {shares}; {1e3 * outcome.behind_s:.0f} ms late at most",
                "0 lost, < 0.15 of a core" if sensor[0] == 400 else "0 lost",
                threads=os.cpu_count() or 1,
            )
        )
    return found
