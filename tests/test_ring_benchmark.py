"""The ring's benchmark moves what it says it moves."""

import pytest

from spiked.ring.benchmark import BenchmarkResult, benchmark
from spiked.sensor import Sensor


def test_the_benchmark_moves_blocks_between_processes_and_leaves_nothing() -> None:
    result = benchmark(Sensor(400, 250, 20_000.0), blocks=50)
    assert result.camera_bytes_a_second == 250e6
    assert result.ring_bytes_a_second > 0


def test_its_ratio_is_that_of_ring_to_memcpy() -> None:
    assert BenchmarkResult(3e9, 2e9, 1.0).ratio == pytest.approx(1.5)
