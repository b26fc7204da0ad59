"""The rate of a camera by the host's clock, and when a frame of one camera came in the count of another."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.recording.host_time import host_times_ns
from spiked.recording.reader import Recording
from spiked.recording.sidecar import ClockPair

__all__ = ["MeasuredRate", "Offset", "measured_rate", "offset"]

LEAST_PAIRS = 4
"""Clock pairs that a rate needs: three determine a parabola without an error."""
COMMON_S = 8.0
"""Clock pairs that are less far apart say the same: the line that they lie on is fitted to so many seconds."""
DELAY_S = 50e-6
"""Standard deviation, for each camera, of what a busy host delays all its frames by, which no jitter shows: the offset
of two virtual cameras was off by 68 us RMS in 13 recordings (docs/recordings.md)."""
DRIFT_PAIRS = 8
"""Clock pairs that a drift needs."""


@dataclass(frozen=True)
class MeasuredRate:
    """Rate of a camera by the host's clock."""

    hz: float
    """Mean over the recording."""
    sigma_hz: float
    """Standard deviation, for independent errors of the clock pairs."""
    drift_ppm_s: float | None
    """Relative change of the rate, parts per million a second; None with fewer than `DRIFT_PAIRS` clock pairs."""
    jitter_s: float
    """Standard deviation of the clock pairs about the line or parabola."""


def measured_rate(pairs: Sequence[ClockPair]) -> MeasuredRate | None:
    """From clock pairs; None with fewer than `LEAST_PAIRS`."""
    if len(pairs) < LEAST_PAIRS:
        return None
    frames = np.array([pair.frame for pair in pairs], np.float64)
    seconds = np.array([pair.unix_ns - pairs[0].unix_ns for pair in pairs]) / 1e9
    middle = frames.mean()
    degree = 2 if len(pairs) >= DRIFT_PAIRS else 1
    basis = np.vander(frames - middle, degree + 1, increasing=True)
    found = np.linalg.lstsq(basis, seconds, rcond=None)[0]
    left = seconds - basis @ found
    variance = float(left @ left) / (len(pairs) - degree - 1)
    period, sigma = found[1], np.sqrt(variance * np.linalg.inv(basis.T @ basis)[1, 1])
    drift = -2e6 * found[2] / period**2 if degree == 2 else None
    return MeasuredRate(1 / period, float(sigma / period**2), drift, float(np.sqrt(variance)))


@dataclass(frozen=True)
class Offset:
    """How the frames of two recordings lie in time. Times are those at which frames had arrived whole."""

    seconds: float
    """From the first frame of the one to the first frame of the other; negative if the other began earlier."""
    sigma_s: float | None
    """Standard deviation, from the jitter of both clocks' pairs, of which those less than `COMMON_S` apart count as
    one, and from `DELAY_S`. None with fewer than `LEAST_PAIRS` of one."""
    first: "Recording"
    second: "Recording"

    def frames_of_second(self, frames_of_first: ArrayLike) -> NDArray[np.float64]:
        """Place in the second recording's count of frames [...] of the first, not whole numbers.

        Frames are indices in the capture, see `Recording.capture_index`.
        """
        wanted = self.first.unix_ns(frames_of_first)
        rate_hz = self.second.sensor.frame_rate_hz
        found = (wanted - self.second.unix_ns(0)) * (rate_hz / 1e9)
        for _ in range(2):  # the line between two clock pairs is not that of the stated rate
            found = found + (wanted - host_times_ns(self.second.clock, found, rate_hz)) * (rate_hz / 1e9)
        return np.asarray(found, np.float64)


def offset(first: Recording, second: Recording) -> Offset:
    """Of two recordings by one host. Raises RecordingError if one of them has no clock pairs."""
    starts = [int(one.unix_ns(0)) for one in (first, second)]
    errors = [_error_s(one) for one in (first, second)]
    known = [error for error in errors if error is not None]
    sigma_s = math.hypot(*known) if len(known) == len(errors) else None
    return Offset((starts[1] - starts[0]) / 1e9, sigma_s, first, second)


def _error_s(recording: Recording) -> float | None:
    """Standard deviation of the time of its first frame."""
    rate = measured_rate(recording.clock)
    if rate is None:
        return None
    span_s = (recording.clock[-1].unix_ns - recording.clock[0].unix_ns) / 1e9
    return math.hypot(DELAY_S, rate.jitter_s / math.sqrt(max(1.0, span_s / COMMON_S)))
