"""Image pyramid of views: large images are fitted at smaller sizes first."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spiked.recon.frontend.demosaic import fill_mosaic
from spiked.recon.frontend.windowing import View, luminance
from spiked.recon.mapping.render_requests import RenderRequest
from spiked.render import Camera, RenderedImage, rasteriser_for
from spiked.render.splats import AnySplats
from spiked.sensor import Image, Mosaic, Sensor

SMALLEST_PIXELS = 50_000
"""No level has fewer pixels (decision 5)."""


@dataclass(frozen=True)
class Target:
    """A view at the size of a level."""

    values: Image
    """Rates [H, W], or [H, W, 3] where a mosaic's tiles have become pixels."""
    deviation: Image
    """Their standard deviation, of the same shape; infinite for masked pixels."""
    windows: Image | None
    """[2, H, W], when each pixel looks, in sub-frames (`Rasteriser.forward_moving`); None: the camera stands still."""
    pixel: int = 1
    """Size of its pixels in sensor pixels."""


class Level:
    """The sensor with pixels `factor` times as large; a mosaic's tiles then are pixels of three colours."""

    def __init__(self, sensor: Sensor, camera: Camera, factor: int, threads: int | None) -> None:
        self.factor = factor
        self._threads = threads
        self._mosaic = sensor.mosaic
        self.camera = Camera(camera.intrinsics.scaled(1 / factor), camera.width // factor, camera.height // factor)
        self.rasteriser = rasteriser_for(self.camera, threads)
        self.channels: NDArray[np.uint8] | None = None
        if sensor.mosaic is not None and factor == 1:
            self.channels = sensor.mosaic.channels(sensor.height, sensor.width)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name != "rasteriser"}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self.rasteriser = rasteriser_for(self.camera, self._threads)

    @property
    def mosaic(self) -> Mosaic | None:
        """The mosaic of this level's images; None where pixels have all colours or none."""
        return None if self.channels is None else self._mosaic

    def render(
        self,
        scene: AnySplats,
        request: RenderRequest,
        windows: Image | None,
        background: float = 0.0,
        *,
        demosaiced: bool = False,
    ) -> RenderedImage:
        """Render a scene at this size over the windows of a `Target`. `background` is a radiance.

        `demosaiced`: all colours at every pixel, as in `demosaiced_target`.
        """
        poses, channels = (request.rotations, request.centres), None if demosaiced else self.channels
        if windows is None:
            return self.rasteriser.forward(scene, *poses, channels=channels, background=background)
        return self.rasteriser.forward_moving(scene, *poses, windows, channels=channels, background=background)

    def demosaiced_target(self, target: Target) -> Target:
        """A mosaic's target [H, W] of this size with colours interpolated, [H, W, 3]."""
        deviation = np.repeat(target.deviation[..., None], 3, -1)
        return replace(target, values=fill_mosaic(target.values, self.channels), deviation=deviation)

    def target(self, view: View, request: RenderRequest) -> Target:
        """A view at this size for the render of a request; incomplete large pixels at the right and lower edges are
        left out.

        Pixels that look much longer than the request are masked; a large pixel if at least half of its pixels are.
        """
        windows: Image | None = None
        seen: NDArray[np.bool_] | None = None
        if request.sub_frames:
            _, windows, seen = view.exposure(request.sub_frames)
        if self.factor == 1:
            deviation = view.deviation if seen is None else np.where(seen, view.deviation, np.float32(np.inf))
            return Target(view.rate, deviation, windows)
        small = None if windows is None else np.ascontiguousarray(np.stack([self._mean(w) for w in windows]))
        values, deviation = self._small(view)
        if seen is not None:
            enough = self._mean(seen.astype(np.float32)) > 0.5
            deviation[~enough] = np.inf
        return Target(values, deviation, small, self.factor)

    def _small(self, view: View) -> tuple[Image, Image]:
        """Rates and their deviations of large pixels."""
        if self._mosaic is None:
            return self._mean(view.rate), self._mean(view.deviation) / np.float32(self.factor)
        values = _tiles(view.rate, self._mosaic)
        deviation = np.sqrt(_tiles(view.deviation**2, self._mosaic)) * _GREEN_SHARE
        rest = self.factor // 2
        return (
            np.stack([_mean(values[..., c], rest) for c in range(3)], -1),
            np.stack([_mean(deviation[..., c], rest) / np.float32(rest) for c in range(3)], -1),
        )

    def shrunk(self, image: Image) -> Image:
        """A grey image [H, W] at this size."""
        return image if self.factor == 1 else self._mean(image)

    def grey(self, image: Image) -> Image:
        """Grey [H, W] of this level's renders or targets: all colours in the same proportion."""
        if image.ndim == 3:
            return np.ascontiguousarray(image.mean(-1, dtype=np.float32))
        return luminance(image, self.mosaic)

    def _mean(self, image: Image) -> Image:
        return _mean(image, self.factor)


def levels(sensor: Sensor, camera: Camera, threads: int | None) -> list[Level]:
    """From the full size down, each half of the one before."""
    out = [Level(sensor, camera, 1, threads)]
    while camera.width * camera.height / (2 * out[-1].factor) ** 2 >= SMALLEST_PIXELS:
        out.append(Level(sensor, camera, 2 * out[-1].factor, threads))
    return out


_GREEN_SHARE = np.array([1, np.sqrt(0.5), 1], np.float32)
"""Green is the mean of two sites."""


def _mean(image: Image, factor: int) -> Image:
    """Means of squares of pixels."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    squares = image[: height * factor, : width * factor].reshape(height, factor, width, factor)
    return np.ascontiguousarray(squares.mean((1, 3), dtype=np.float32))


def _tiles(image: Image, mosaic: Mosaic) -> Image:
    """[H / 2, W / 2, 3] from a mosaic's sites [H, W]."""
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    tile = mosaic.channels(2, 2)
    out = np.zeros((height // 2, width // 2, 3), np.float32)
    for r in range(2):
        for c in range(2):
            colour = tile[r, c]
            share = 0.5 if colour == 1 else 1.0
            out[..., colour] += np.float32(share) * image[r:height:2, c:width:2]
    return out
