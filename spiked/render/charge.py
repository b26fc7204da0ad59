"""Charge loss: compares a rendered image, moved along the image motion, with the spikes of many frames.

A pixel fires whenever it has gathered the charge of one spike. Between two of its spikes, then, the light that it saw
of the image, as that moved past, adds up to one, whatever the motion and however long it took. An image rendered at
one moment, carried along its motion to every frame, is thereby compared with all intervals of many frames: for the
price of one render and without the smear of a long window.
"""

from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.native._charge import ChargeLoss as _ChargeLoss
from spiked.render.cpu import MAX_THREADS, usable_cores
from spiked.render.splats import Floats
from spiked.sensor import BitOrder, Sensor

WARP_CELL_PX = 8
"""Spacing in px of the nodes at which displacements are given."""
JITTER = 0.02
"""Standard deviation of an interval's charge beside that of its ends, in spikes."""


@dataclass(frozen=True)
class Charge:
    """Result of the charge loss."""

    loss: float
    """Mean over the pixels of weight * squared error, (spikes a frame)^2."""
    slope: Floats
    """Gradient with respect to the image, of its shape."""
    chi2: float
    """Mean squared residual of an interval in units of its variance; 0 without any interval."""
    brightness: float
    """Spikes counted over spikes expected, by the pixels that roughly agree; 1 without any."""


def charge_means(
    loss: float, pixels: float, chi2: float, intervals: float, expected: float, counted: float
) -> tuple[float, float, float]:
    """Loss, chi2 and brightness of `Charge`, from the sums of a kernel."""
    return (
        loss / max(pixels, 1.0),
        chi2 / intervals if intervals > 0 else 0.0,
        counted / expected if expected > 0 else 1.0,
    )


class SpikeLayout(TypedDict):
    """How the kernel reads the bits of a stored frame; tile [4] has the colours of a mosaic's 2x2 sites."""

    width: int
    height: int
    row_stride: int
    flipped: bool
    msb: bool
    tile: NDArray[np.uint8]


class ChargeLoss:
    """Compares images with frames. Not thread-safe; the result does not depend on the number of threads."""

    def __init__(self, sensor: Sensor, threads: int | None = None) -> None:
        """Threads default to the cores this process may use."""
        threads = usable_cores() if threads is None else threads
        if not 1 <= threads <= MAX_THREADS:
            raise ConfigurationError(f"cannot work with {threads} threads: use 1 to {MAX_THREADS}")
        self.sensor = sensor
        self._threads = threads
        self._native = _ChargeLoss(threads)
        mosaic = None if sensor.mosaic is None else sensor.mosaic.channels(2, 2).ravel()
        self.layout: SpikeLayout = {
            "width": sensor.width,
            "height": sensor.height,
            "row_stride": sensor.row_stride,
            "flipped": sensor.flipped,
            "msb": sensor.bit_order is BitOrder.MSB,
            "tile": np.zeros(4, np.uint8) if mosaic is None else np.ascontiguousarray(mosaic),
        }

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name != "_native"}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._native = _ChargeLoss(self._threads)

    def __call__(
        self,
        image: Floats,
        frames: NDArray[np.uint8],
        displacements: Floats,
        gain: Floats,
        dark: Floats | None = None,
        *,
        pixel: int = 1,
        every: int = 1,
        phase: int = 0,
        floor: float,
        jitter: float = JITTER,
    ) -> Charge:
        """Loss, slope and brightness of an image in spikes a frame.

        image [h, w], or [h, w, 3] for a mosaic, shows the sensor's field at one moment, its pixels `pixel` times as
        large as the sensor's. frames [n, frame_bytes] as stored, at most 64 of them; displacements float32
        [n, rows, columns, 2] lead, in px, from nodes `WARP_CELL_PX` apart (first: the sensor's corner) in each frame to
        where the same things are in the image. gain [H, W] multiplies the light (0: a pixel that does not count),
        dark [H, W] is added to it, in spikes a frame. Of `every` pairs of the sensor's rows, the one of number `phase`
        is used.

        The variance of an interval's charge is rate^2 / 6 (spikes are only known to the frame) plus jitter^2; that
        before the first and after the last spike is 1 / 6. A pixel's residuals are weighted so that an error e of its
        rate costs e^2 floor^2 / (deviation^2 + floor^2). Raises ConfigurationError for shapes that do not fit.
        """
        planes = np.ascontiguousarray(image, np.float32)
        planes = planes[..., None] if planes.ndim == 2 else planes
        slope = np.empty_like(planes)
        if frames.dtype != np.uint8:
            raise ConfigurationError(f"frames are bytes as they are stored, not {frames.dtype}")
        try:
            sums = self._native.run(
                **self.layout,
                frames=np.ascontiguousarray(frames),
                grids=np.ascontiguousarray(displacements, np.float32),
                cell=WARP_CELL_PX,
                image=planes,
                pixel=pixel,
                every=every,
                phase=phase,
                gain=np.ascontiguousarray(gain, np.float32),
                dark=None if dark is None else np.ascontiguousarray(dark, np.float32),
                floor=floor,
                jitter=jitter,
                slope=slope,
            )
        except ValueError as error:
            raise ConfigurationError(f"images, frames and displacements do not fit: {error}") from error
        slope /= np.float32(max(sums[1], 1.0))
        loss, chi2, brightness = charge_means(*sums)
        return Charge(loss, slope.reshape(image.shape), chi2, brightness)
