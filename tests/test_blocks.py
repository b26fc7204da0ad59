"""Spike-aligned windows against plain NumPy, on random bits and on real recordings, for every instruction set."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from spiked.blocks import Window, aligned_window, benchmark, instruction_sets, unpack
from spiked.errors import ConfigurationError
from spiked.sensor import BitOrder, Layout, Sensor

REAL = Path(__file__).parents[2] / "shared" / "real"
SETS = instruction_sets()
Bits = NDArray[np.bool_]


def stored(bits: Bits, sensor: Sensor) -> NDArray[np.uint8]:
    """Upright bits [n, height, width] to stored frames [n, frame_bytes]."""
    if sensor.flipped:
        bits = bits[:, ::-1]
    order = "little" if sensor.bit_order is BitOrder.LSB else "big"
    rows = np.packbits(bits, axis=2, bitorder=order)
    if sensor.layout is Layout.ROW_TAGGED:
        tags = np.arange(sensor.height, dtype="<u2").view(np.uint8).reshape(1, -1, 2)
        rows = np.concatenate([rows, np.broadcast_to(tags, (len(bits), sensor.height, 2))], axis=2)
    return np.ascontiguousarray(rows.reshape(len(bits), -1))


def random_bits(rng: np.random.Generator, n: int, height: int, width: int) -> Bits:
    """Bits whose rate differs from pixel to pixel, from never to nearly always."""
    rate = rng.choice([0.0, 0.01, 0.03, 0.1, 0.3, 0.9], (height, width))
    return rng.random((n, height, width)) < rate


def naive_window(times: NDArray[np.int64], begin: int, end: int) -> tuple[int, int, int]:
    """(spikes, start, stop) of one pixel from its spike times, written from the definition and not from the kernel."""
    if len(times) == 0:
        return 0, -1, -1
    # The distance of frame k's middle from an edge; of two equal ones the outer spike.
    i = min(range(len(times)), key=lambda j: (abs(times[j] + 0.5 - begin), times[j]))
    j = min(range(len(times)), key=lambda j: (abs(times[j] + 0.5 - end), -times[j]))
    if i == j:
        i, j = max(i - 1, 0), min(j + 1, len(times) - 1)
    return j - i, int(times[i]), int(times[j])


def naive_windows(bits: Bits, begin: int, end: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """As `naive_window` for many pixels, bits [n, pixels], by the ranks of spikes; fast enough for a million."""
    n, pixels = bits.shape
    k = np.arange(n)[:, None]
    total = bits.cumsum(axis=0)
    # Doubled distances; the outer of two equal ones is made the nearer.
    to_begin = np.where(bits, 2 * np.abs(2 * k + 1 - 2 * begin) + (k >= begin), 2**40)
    to_end = np.where(bits, 2 * np.abs(2 * k + 1 - 2 * end) + (k < end), 2**40)
    pixel = np.arange(pixels)
    i, j = total[to_begin.argmin(axis=0), pixel], total[to_end.argmin(axis=0), pixel]
    alone = i == j
    i = np.where(alone, np.maximum(i - 1, 1), i)
    j = np.where(alone, np.minimum(j + 1, total[-1]), j)
    start, stop = (total >= i).argmax(axis=0), (total >= j).argmax(axis=0)
    silent = total[-1] == 0
    return np.where(silent, 0, j - i), np.where(silent, -1, start), np.where(silent, -1, stop)


@pytest.mark.validation
def test_windows_equal_numpy_in_a_million_random_cases(figure: Callable[[str, object, str], None]) -> None:
    sensor = Sensor(1000, 50, 20_000.0)
    rng = np.random.default_rng(20)
    for _ in range(20):
        n = int(rng.integers(10, 41))
        begin, end = sorted(int(edge) for edge in rng.choice(n + 1, 2, replace=False))
        bits = random_bits(rng, n, 50, 1000)
        window = aligned_window(stored(bits, sensor), sensor, 0, begin, end)
        spikes, start, stop = naive_windows(bits.reshape(n, -1), begin, end)
        np.testing.assert_array_equal(window.spikes.ravel(), spikes)
        np.testing.assert_array_equal(window.start.ravel(), start)
        np.testing.assert_array_equal(window.stop.ravel(), stop)
    figure("aligned windows that differ, of 1,000,000 random ones", 0, "exact")


def check_window(window: Window, bits: Bits) -> None:
    """Compare every pixel; bits [n, height, width] are the frames that the window looked at."""
    height, width = bits.shape[1:]
    k, pixel = np.nonzero(bits.reshape(len(bits), -1))
    order = np.argsort(pixel, kind="stable")
    per_pixel = np.split(k[order] + window.first_frame, np.searchsorted(pixel[order], np.arange(1, height * width)))
    expected = np.array([naive_window(times, window.begin, window.end) for times in per_pixel])
    np.testing.assert_array_equal(window.spikes.ravel(), expected[:, 0])
    np.testing.assert_array_equal(window.start.ravel(), expected[:, 1])
    np.testing.assert_array_equal(window.stop.ravel(), expected[:, 2])
    inside = bits[window.begin - window.first_frame : window.end - window.first_frame]
    np.testing.assert_array_equal(window.count, inside.sum(axis=0))


sensors = st.builds(
    Sensor,
    width=st.integers(1, 90).map(lambda n: 8 * n),
    height=st.integers(1, 7),
    frame_rate_hz=st.just(20_000.0),
    layout=st.sampled_from(Layout),
    bit_order=st.sampled_from(BitOrder),
    flipped=st.booleans(),
)


@settings(max_examples=30, deadline=None)
@given(sensor=sensors, data=st.data(), seed=st.integers(0, 2**32 - 1))
def test_windows_equal_numpy_for_any_sensor(sensor: Sensor, data: st.DataObject, seed: int) -> None:
    n = data.draw(st.integers(1, 60))
    begin = data.draw(st.integers(0, n - 1))
    end = data.draw(st.integers(begin + 1, n))
    bits = random_bits(np.random.default_rng(seed), n, sensor.height, sensor.width)
    for name in SETS:
        check_window(aligned_window(stored(bits, sensor), sensor, 7, begin + 7, end + 7, instruction_set=name), bits)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize(("n", "begin", "end"), [(96, 32, 64), (64, 0, 64), (700, 300, 316), (900, 100, 890)])
def test_windows_equal_numpy_on_many_pixels_and_long_runs(name: str, n: int, begin: int, end: int) -> None:
    """Runs of more than 248 frames take several passes in the kernel."""
    sensor = Sensor(400, 25, 20_000.0) if n < 100 else Sensor(136, 20, 20_000.0)
    bits = random_bits(np.random.default_rng(n), n, sensor.height, sensor.width)
    if n >= 100:
        bits &= np.random.default_rng(n + 1).random(bits.shape) < 0.05
    check_window(
        aligned_window(stored(bits, sensor), sensor, 10**12, 10**12 + begin, 10**12 + end, instruction_set=name), bits
    )


@pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings in ../shared/real are not here")
@pytest.mark.parametrize("name", SETS)
def test_windows_are_exact_on_a_real_recording(name: str) -> None:
    sensor = Sensor(400, 250, 20_000.0)
    frames = np.memmap(REAL / "reds_rocks.dat", np.uint8, "r").reshape(-1, sensor.frame_bytes)[100:150]
    bits = np.unpackbits(frames, axis=1, bitorder="little").reshape(-1, 250, 400)[:, ::-1].astype(bool)
    window = aligned_window(frames, sensor, 100, 117, 133, instruction_set=name)
    spikes, start, stop = naive_windows(bits.reshape(50, -1), 17, 33)
    np.testing.assert_array_equal(window.spikes.ravel(), spikes)
    np.testing.assert_array_equal(window.start.ravel(), start + 100)
    np.testing.assert_array_equal(window.stop.ravel(), stop + 100)


def test_strided_views_are_read_in_place() -> None:
    sensor = Sensor(64, 3, 20_000.0)
    bits = random_bits(np.random.default_rng(3), 16, 3, 64)
    view = stored(bits, sensor)[::2]
    check_window(aligned_window(view, sensor, 0, 2, 6), bits[::2])


def one_pixel(times: list[int], begin: int, end: int) -> Window:
    sensor = Sensor(8, 1, 20_000.0)
    bits = np.zeros((40, 1, 8), bool)
    bits[times, 0, 0] = True
    return aligned_window(stored(bits, sensor), sensor, 100, 100 + begin, 100 + end)


def test_a_regular_pixel_gives_its_rate_and_time_centre() -> None:
    window = one_pixel([3, 8, 13, 18, 23, 28, 33], 10, 24)
    assert (window.spikes[0, 0], window.start[0, 0], window.stop[0, 0], window.count[0, 0]) == (3, 108, 123, 3)
    assert window.rate()[0, 0] == np.float32(0.2)
    assert window.centre()[0, 0] == 116.0


def test_equal_distances_take_the_outer_spikes() -> None:
    window = one_pixel([8, 11, 18, 21], 10, 20)
    assert (window.start[0, 0], window.stop[0, 0], window.spikes[0, 0]) == (108, 121, 3)


@pytest.mark.parametrize(
    ("times", "expected"), [([2, 14, 35], (2, 102, 135)), ([14, 35], (1, 114, 135)), ([2, 14], (1, 102, 114))]
)
def test_a_single_spike_near_both_edges_extends_outwards(times: list[int], expected: tuple[int, int, int]) -> None:
    window = one_pixel(times, 10, 20)
    assert (window.spikes[0, 0], window.start[0, 0], window.stop[0, 0]) == expected


def test_without_an_interval_there_is_a_bound_instead_of_a_rate() -> None:
    silent, once = one_pixel([], 10, 20), one_pixel([14], 10, 20)
    assert not silent.valid.any()
    assert not once.valid.any()
    assert np.isnan(once.rate()[0, 0]) and np.isnan(once.centre()[0, 0])
    assert silent.rate_bound()[0, 0] == np.float32(1 / 40)
    assert once.rate_bound()[0, 0] == np.float32(2 / 40)
    assert once.rate(fill=True)[0, 0] == np.float32(1 / 40)
    assert (silent.start[0, 0], once.start[0, 0], once.stop[0, 0]) == (-1, 114, 114)


@pytest.mark.parametrize(("begin", "end"), [(5, 5), (-1, 4), (0, 9)])
def test_a_window_outside_the_frames_is_refused(begin: int, end: int) -> None:
    with pytest.raises(ValueError, match="inside the frames"):
        aligned_window(np.zeros((8, 2), np.uint8), Sensor(16, 1, 1.0), 0, begin, end)


def test_frames_of_another_sensor_are_refused() -> None:
    with pytest.raises(ValueError, match=r"uint8 \[n, 2\]"):
        aligned_window(np.zeros((8, 3), np.uint8), Sensor(16, 1, 1.0), 0, 2, 6)


def test_benchmark_measures_every_instruction_set() -> None:
    rows = benchmark(repeats=1)
    assert len(rows) == 2 * len(SETS)
    assert all(row.ns_per_frame > 0 and row.memcpy_ratio > 0 for row in rows)


@pytest.mark.parametrize("level", SETS)
def test_the_environment_forces_an_instruction_set(level: str) -> None:
    program = "from spiked import blocks; print(*blocks.instruction_sets())"
    environment = {**os.environ, "SPIKED_SIMD": level}
    run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.split() == [level]


def test_an_unknown_instruction_set_is_refused() -> None:
    program = "from spiked import blocks; blocks.instruction_sets()"
    environment = {**os.environ, "SPIKED_SIMD": "mmx"}
    run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert "SPIKED_SIMD=mmx" in run.stderr


def test_arrays_of_other_types_are_refused() -> None:
    """They would be converted, and the images be written into a copy."""
    sensor = Sensor(16, 8, 1000.0)
    frames = np.zeros((3, sensor.frame_bytes), np.uint8)
    wrong = (np.empty((3, 8, 16), np.float32), np.empty((3, 8, 16), bool), np.empty((3, 8, 32), np.uint8)[:, :, ::2])
    for out in wrong:
        with pytest.raises(ConfigurationError, match="arrays of uint8"):
            unpack(frames, sensor, out=out)  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="got float32"):
        unpack(frames.astype(np.float32), sensor)  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        aligned_window(frames.astype(np.float32), sensor, 0, 0, 3)  # type: ignore[arg-type]


@pytest.mark.parametrize("sensor", [Sensor(400, 250, 1.0), Sensor(48, 5, 1.0, flipped=False)], ids=str)
def test_unpacked_images_are_the_bits(sensor: Sensor) -> None:
    bits = np.random.default_rng(3).random((5, sensor.height, sensor.width)) < 0.3
    frames = stored(bits, sensor)
    assert (unpack(frames, sensor) == bits).all()
    out = np.full((7, sensor.height, sensor.width), 9, np.uint8)
    assert (unpack(frames, sensor, out=out) == bits).all()
    assert (out[5:] == 9).all()
    with pytest.raises(ValueError, match="fewer images"):
        unpack(frames, sensor, out=out[:4])
