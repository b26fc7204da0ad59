"""When frames came, from when they were seen: late by whatever the host was busy with."""

import numpy as np
import pytest
from spiked_driver.frame_clock import FrameClock

START_NS = 5_000_000_000_000


def errors_ms(true_hz: float, stated_hz: float, seconds: float, *, chunk: int, seed: int) -> np.ndarray:
    """Of the clock's own time for the newest frame, each time there is a new line; the delays have a heavy tail."""
    rng = np.random.default_rng(seed)
    clock, errors, free_ns = FrameClock(stated_hz), [], 0
    for frame in range(chunk - 1, round(seconds * true_hz), chunk):
        came_ns = START_NS + round(1e9 * (frame + 1) / true_hz)
        delay_ms = 0.05 + rng.exponential(4.0) + (rng.uniform(0, 400) if rng.random() < 0.03 else 0)
        free_ns = max(free_ns, came_ns + round(1e6 * delay_ms))  # one is seen after the other
        if clock.arrived(frame, free_ns):
            unix_ns = clock.unix_ns(frame)
            assert unix_ns is not None
            if clock.settled:
                errors.append((unix_ns - clock._unix_ns - came_ns) / 1e6)
    return np.array(errors)


@pytest.mark.parametrize(
    ("true_hz", "stated_hz", "chunk"), [(20_000.0, 20_000.0, 80), (2000.0, 2000.0, 20), (1999.0, 2000.0, 80)]
)
def test_a_busy_host_is_wrong_by_less_than_a_millisecond(true_hz: float, stated_hz: float, chunk: int) -> None:
    errors = np.concatenate([errors_ms(true_hz, stated_hz, 30, chunk=chunk, seed=seed) for seed in range(5)])
    assert np.percentile(np.abs(errors), 99) < 1.0, np.percentile(np.abs(errors), [50, 90, 99, 100])


def test_the_rate_is_measured_whatever_was_stated() -> None:
    clock = FrameClock(20_000.0)
    for frame in range(0, 20_000, 20):
        clock.arrived(frame, START_NS + round(frame * 1e9 / 1987.0))
    assert clock.settled
    assert clock.wrong_rate() == pytest.approx(1987.0, rel=1e-6)


def test_a_rate_within_the_error_of_a_busy_host_is_no_warning() -> None:
    clock = FrameClock(2000.0)
    for frame in range(0, 2000, 20):
        clock.arrived(frame, START_NS + round(frame * 1e9 / 2000.0) + (15_000_000 if frame < 1000 else 0))
    assert clock.fit(START_NS) and not clock.settled
    assert clock.wrong_rate() is None


def test_what_a_camera_had_kept_does_not_bend_the_line() -> None:
    """Two seconds of frames come within 0.4 s, then the others as they are taken."""
    clock = FrameClock(2000.0)
    for frame in range(0, 14_000, 20):
        came_ns = 500_000 * frame
        seen_ns = max(came_ns, 2_000_000_000 + 100_000 * frame)
        if clock.arrived(frame, START_NS + seen_ns) and clock.settled:
            unix_ns = clock.unix_ns(frame)
            assert unix_ns is not None
            assert unix_ns - clock._unix_ns == pytest.approx(START_NS + came_ns, abs=10_000)
            assert clock.wrong_rate() is None


def test_a_break_is_no_reason_to_draw_a_line_across_it() -> None:
    clock = FrameClock(1000.0)
    for frame in range(5000):
        clock.arrived(frame, START_NS + 1_000_000 * frame)
    clock.restart()
    assert clock.unix_ns(5000) is None and not clock.fit(START_NS)
    for frame in range(9000, 9500):  # 4 s were lost, and 3 are told of
        clock.arrived(frame, START_NS + 1_000_000 * (frame + 1000))
    assert clock.fit(START_NS)
    unix_ns = clock.unix_ns(9500)
    assert unix_ns is not None
    assert unix_ns - clock._unix_ns == START_NS + 1_000_000 * 10_500
