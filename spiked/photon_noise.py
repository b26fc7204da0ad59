"""Measures the noise of a single-photon camera from a recording of a static scene."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.blocks import unpack
from spiked.errors import RecordingError
from spiked.recording import Recording

__all__ = ["PhotonNoiseReport", "PhotonWindowNoise", "measure_photon_noise"]

LENGTHS = (16, 32, 64, 128, 256)
"""Frames of the windows that are compared."""
LEAST_WINDOWS = 4
"""Fewest windows of one length for its variance."""
LEAST_COUNTS = 8
"""Fewest frames in which a pixel fires, and in which it does not, for a flux."""
CHUNK = 64
"""Frames unpacked at a time."""
HOT_SHARE = 0.5
"""A pixel that fires in this share of the frames more often than the median of all is called hot."""


@dataclass(frozen=True)
class PhotonWindowNoise:
    """Noise of counts in windows of so many frames; relative errors are medians over the pixels."""

    frames: int
    windows: int
    variance: float
    """Of the number of frames in which a pixel fires, over that of independent photons: 1 if there is nothing else."""
    flux_error: float
    """Relative standard deviation of the flux that the counts say."""
    photon_error: float
    """The same if photons were the only noise."""


@dataclass(frozen=True)
class PhotonNoiseReport:
    """See `measure_photon_noise`."""

    frames: int
    rate: float
    """Share of the frames in which a pixel fires, mean over all pixels."""
    flux: float
    """Photons detected a pixel and frame, -log(1 - p), median over the pixels."""
    afterpulsing: float
    """Share by which a pixel fires more often in the frame after one in which it fired; negative: dead time."""
    crosstalk: float
    """Share by which a pixel fires more often in a frame in which its neighbour in the row fires."""
    hot_pixels: int
    """Pixels that fire far more often than the others; in a scene they may be its lights."""
    windows: tuple[PhotonWindowNoise, ...]


def measure_photon_noise(recording: Recording, most_frames: int = 2048) -> PhotonNoiseReport:
    """Noise in the first `most_frames` frames, in which the scene must be static, with constant light.

    Raises RecordingError for recordings of less than 4 windows of the shortest length, and where no pixel has a flux
    that counts can say: too dark, or it fires in all frames.
    """
    count = min(recording.frames, most_frames)
    lengths = [length for length in LENGTHS if count // length >= LEAST_WINDOWS]
    if not lengths:
        least = LENGTHS[0] * LEAST_WINDOWS
        raise RecordingError(f"{recording.path}: {count} frames are too few to measure noise; {least} are the least")
    sums = _Sums.of(recording, count)
    total = sums.counts.sum(0)
    used = (total >= LEAST_COUNTS) & (total <= count - LEAST_COUNTS)
    if not used.any():
        raise RecordingError(
            f"{recording.path}: no pixel fires in {LEAST_COUNTS} of {count} frames and rests in as many; use a scene "
            "that is neither dark nor so bright that every frame has a photon, or more frames"
        )
    p = total / count
    expected = p[used]
    level = float(np.median(p))
    windows = tuple(_window(sums.counts, used, expected, length, count) for length in lengths)
    return PhotonNoiseReport(
        frames=count,
        rate=float(p.mean()),
        flux=float(np.median(-np.log1p(-expected))),
        afterpulsing=float((sums.again[used].sum() / (count - 1)) / (expected**2).sum() - 1),
        crosstalk=_crosstalk(sums, p, used, count),
        hot_pixels=int((p > level + HOT_SHARE).sum()),
        windows=windows,
    )


@dataclass(frozen=True)
class _Sums:
    """Counts of pieces of `LENGTHS[0]` frames [m, H, W], and of coincidences [H, W]."""

    counts: NDArray[np.int64]
    again: NDArray[np.int64]
    """Frames after one with a count, with another one."""
    beside: NDArray[np.int64]
    """Frames in which the right neighbour fires, too; [H, W - 1]."""

    @classmethod
    def of(cls, recording: Recording, count: int) -> "_Sums":
        sensor = recording.sensor
        shape = sensor.height, sensor.width
        counts, again = [], np.zeros(shape, np.int64)
        beside = np.zeros((shape[0], shape[1] - 1), np.int64)
        last = np.zeros(shape, np.uint8)
        for first in range(0, count, CHUNK):
            bits = unpack(np.ascontiguousarray(recording.read(first, min(CHUNK, count - first))), sensor)
            before = np.concatenate([last[None], bits[:-1]])
            again += (bits & before).sum(0, dtype=np.int64)
            beside += (bits[:, :, 1:] & bits[:, :, :-1]).sum(0, dtype=np.int64)
            counts += [
                bits[begin : begin + LENGTHS[0]].sum(0, dtype=np.int64) for begin in range(0, len(bits), LENGTHS[0])
            ]
            last = bits[-1]
        return cls(np.array(counts), again, beside)


def _window(
    pieces: NDArray[np.int64], used: NDArray[np.bool_], p: NDArray[np.float64], length: int, count: int
) -> PhotonWindowNoise:
    joined = length // LENGTHS[0]
    number = count // length
    counts = pieces[: number * joined, used].reshape(number, joined, -1).sum(1).astype(np.float64)
    expected = length * p * (1 - p)
    flux = -np.log1p(-p)
    slope = 1 / (length * (1 - p) * flux)  # of the relative flux by a count
    return PhotonWindowNoise(
        length,
        number,
        float(counts.var(0, ddof=1).sum() / expected.sum()),
        float(np.median(counts.std(0, ddof=1) * slope)),
        float(np.median(np.sqrt(expected) * slope)),
    )


def _crosstalk(sums: _Sums, p: NDArray[np.float64], used: NDArray[np.bool_], count: int) -> float:
    both = used[:, 1:] & used[:, :-1]
    if not both.any():
        return 0.0
    expected = (p[:, 1:] * p[:, :-1])[both].sum()
    return float(sums.beside[both].sum() / count / expected - 1)
