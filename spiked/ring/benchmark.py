"""Throughput of a ring between two processes, compared with copying the same blocks in one process."""

import multiprocessing
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.ring.items import End, Policy, RingError
from spiked.ring.reader import Frames, RingReader
from spiked.ring.writer import RingWriter
from spiked.sensor import Sensor

_START_S = 30.0
"""Time for the reading process to attach, seconds."""


@dataclass(frozen=True)
class BenchmarkResult:
    """Throughput of copying blocks into a ring here and out of it in another process, without a loss."""

    ring_bytes_a_second: float
    memcpy_bytes_a_second: float
    """The same copies, in and out, in one process without a ring."""
    camera_bytes_a_second: float
    """Data rate of the sensor."""

    @property
    def ratio(self) -> float:
        """Ring to memcpy; with a core for each process it may exceed 1, as the two copies overlap."""
        return self.ring_bytes_a_second / self.memcpy_bytes_a_second


def benchmark(sensor: Sensor, *, blocks: int = 4000, block_frames: int = 8) -> BenchmarkResult:
    """Move `blocks` blocks of the sensor's frames through a ring. Raises RingError if the reader does not attach."""
    compact = sensor.compact()
    block = np.random.default_rng(0).integers(0, 256, (block_frames, compact.frame_bytes), np.uint8)
    total_bytes = blocks * block.nbytes
    with RingWriter.create(compact, block_frames=block_frames) as writer:
        reader = multiprocessing.get_context("spawn").Process(target=_copy_out, args=(writer.name,))
        reader.start()
        try:
            if not writer.wait_for_readers(1, _START_S):
                raise RingError(f"the reading process did not attach to {writer.name} within {_START_S:g} s")
            start_s = time.perf_counter()
            for _ in range(blocks):
                while not writer.wait_for_space(1.0):
                    pass
                writer.acquire()[:] = block
                writer.commit(block_frames)
        finally:
            writer.close()
            reader.join()
        if reader.exitcode:
            raise RingError(f"the reading process failed with exit code {reader.exitcode}; its output says why")
        ring_s = time.perf_counter() - start_s
        slots = writer.geometry.slots
    return BenchmarkResult(
        total_bytes / ring_s,
        total_bytes / _memcpy_seconds(block, blocks, slots),
        compact.frame_bytes * compact.frame_rate_hz,
    )


def _copy_out(name: str) -> None:
    with RingReader.attach(name, Policy.LOSSLESS, "benchmark") as reader:
        geometry = reader.geometry
        target = np.zeros((geometry.block_frames, geometry.sensor.frame_bytes), np.uint8)
        while not isinstance(item := reader.next(1.0), End):
            if isinstance(item, Frames):
                target[: item.count] = item.data


def _memcpy_seconds(block: NDArray[np.uint8], blocks: int, slots: int) -> float:
    """Copy in and out of as many slots as the ring has: more than the caches hold."""
    memory = np.zeros((slots, *block.shape), np.uint8)
    target = np.zeros_like(block)
    start_s = time.perf_counter()
    for number in range(blocks):
        memory[number % slots] = block
        target[:] = memory[number % slots]
    return time.perf_counter() - start_s
