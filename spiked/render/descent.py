"""Gradient descent on a scene by Adam: the splats, their moments, and the step that changes both.

`descent_for` gives the best one here: on a GPU splats and moments stay on the device from step to step.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spiked.render.choice import AnyRasteriser, chosen
from spiked.render.gpu import GpuRasteriser, device_errors
from spiked.render.optimiser import Adam
from spiked.render.splats import AnySplats, DeviceScene, Floats, MeanAxes, SizeLimits
from spiked.scene import Scene


class Stride(NamedTuple):
    """How far a step goes."""

    rates: tuple[float, ...]
    """Of the five arrays, the first in units of the `axes`."""
    limits: SizeLimits
    axes: MeanAxes


class Descent:
    """A scene that is fitted on the CPU."""

    def __init__(self, scene: Scene, beta1: float, beta2: float, threads: int | None = None) -> None:
        self._settings = beta1, beta2, threads
        self.adopt(scene)

    def adopt(self, scene: Scene) -> None:
        """Go on with another scene, without moments."""
        self._restart(scene)

    def _restart(self, scene: Scene) -> None:
        beta1, beta2, threads = self._settings
        self._scene = scene
        self.adam = Adam(scene.arrays(), beta1, beta2, threads=threads)

    @property
    def scene(self) -> Scene:
        """The scene as it is. The next step changes its arrays."""
        return self._scene

    @property
    def model(self) -> AnySplats:
        """The scene as a rasteriser of this kind renders it best."""
        return self._scene

    @property
    def opacity_logits(self) -> Floats:
        """Of the scene, [N]."""
        return self._scene.opacity_logits

    def moved(self) -> "Descent":
        """The same by the renderer that is `chosen`: it may be another one than where this was pickled."""
        fit = descent_for(self.scene, *self._settings)
        fit.adam = self.adam
        return fit

    def replace(self, scene: Scene) -> None:
        """Go on with the same splats elsewhere: their moments stay."""
        self._scene = scene

    def join(self, splats: Scene) -> None:
        """Add splats, without moments."""
        self._scene = self.scene.join(splats)
        self.adam.grow(len(splats))

    def select(self, rows: NDArray[np.bool_]) -> None:
        """Keep the splats at `rows`, [N]."""
        self._scene = self.scene.select(rows)
        self.adam.keep(rows)

    def step(
        self,
        rasteriser: AnyRasteriser,
        slope: Floats,
        rates: tuple[float, ...],
        limits: SizeLimits,
        axes: MeanAxes,
    ) -> None:
        """Change the splats that the last image of `rasteriser`, a render of `model`, shows: slope is the gradient by
        its values, and rates are those of the five arrays, the first in units of the `axes`.

        The axes of the means are those before the step for the gradient, and those after it for the move. Colours below
        0 become 0, as viewers show them as black, and splats stay within the `limits`.
        """
        gradients = rasteriser.backward(slope)
        scene, steps = self._scene, np.zeros_like(self._scene.means)
        by_axes = self.adam.slopes_along_axes(scene, axes, gradients.means)
        _, *others = scene.arrays()
        _, *slopes = gradients.arrays()
        self.adam.step((steps, *others), (by_axes, *slopes), rates, gradients.radius_px > 0)
        self.adam.move_along_axes(scene, axes, steps)
        np.maximum(scene.colours, 0, out=scene.colours)
        np.minimum(scene.log_scales, limits.most(scene.means), out=scene.log_scales)


class DeviceDescent(Descent):
    """A scene that is fitted on a GPU, from the first step on; it is copied back when it is asked for."""

    def __init__(self, scene: Scene, beta1: float, beta2: float, threads: int | None = None) -> None:
        self._device: DeviceScene | None = None
        self._behind = False
        """The scene here is older than the one on the device."""
        super().__init__(scene, beta1, beta2, threads)

    def __getstate__(self) -> dict[str, object]:
        self._fetch()
        return vars(self) | {"_device": None}

    def adopt(self, scene: Scene) -> None:
        """See `Descent.adopt`."""
        super().adopt(scene)
        self._device, self._behind = None, False

    def replace(self, scene: Scene) -> None:
        """See `Descent.replace`."""
        self._fetch()
        super().replace(scene)
        self._device = None

    @property
    def scene(self) -> Scene:
        """See `Descent.scene`; a copy of what is on the device."""
        self._fetch()
        return self._scene

    @property
    def model(self) -> AnySplats:
        """The scene on the device; the one here where it has not been fitted since it was changed."""
        return self._scene if self._device is None else self._device

    @property
    def opacity_logits(self) -> Floats:
        """See `Descent.opacity_logits`."""
        if self._device is None:
            return super().opacity_logits
        logits = np.empty(len(self._device), np.float32)
        with device_errors():
            self._device.native.opacity_logits(logits)
        return logits

    def join(self, splats: Scene) -> None:
        """See `Descent.join`."""
        if self._device is None:
            super().join(splats)
            return
        with device_errors():
            self._device.native.join(*splats.arrays())
        self._behind = True

    def select(self, rows: NDArray[np.bool_]) -> None:
        """See `Descent.select`."""
        if self._device is None:
            super().select(rows)
            return
        with device_errors():
            self._device.native.select(np.flatnonzero(rows).astype(np.uint32))
        self._behind = True

    def step(
        self,
        rasteriser: AnyRasteriser,
        slope: Floats | None,
        rates: tuple[float, ...],
        limits: SizeLimits,
        axes: MeanAxes,
    ) -> None:
        """See `Descent.step`; no slope: that of the last comparison of `rasteriser`, which was of `on_device`."""
        assert isinstance(rasteriser, GpuRasteriser)
        beta1, beta2, _ = self._settings
        scene = self.on_device(rasteriser)
        rasteriser.descend(slope, scene, rates, axes, beta1, beta2, self.adam.epsilon, limits)
        self._behind = True

    def on_device(self, rasteriser: GpuRasteriser) -> DeviceScene:
        """The scene on the device, which `model` is from now on."""
        if self._device is None:
            with device_errors():
                device = rasteriser.device_scene()
                device.native.set(*self._scene.arrays(), *self.adam.packed())
            self._device = device
        return self._device

    def _fetch(self) -> None:
        if not self._behind or self._device is None:
            return
        n, colours = len(self._device), int(self._device.native.colours)
        shapes = (n, 3), (n, 4), (n, 3), (n,), (n, colours)
        means, quats, log_scales, logits, colour = (np.empty(shape, np.float32) for shape in shapes)
        first, second = (np.empty((n, 11 + colours), np.float32) for _ in range(2))
        taken = np.empty(n, np.uint32)
        with device_errors():
            self._device.native.get(means, quats, log_scales, logits, colour, first, second, taken)
        self._restart(Scene(means, quats, log_scales, logits, colour, self._scene.white))
        self.adam.unpack(first, second, taken)
        self._behind = False


def descent_for(scene: Scene, beta1: float, beta2: float, threads: int | None = None) -> Descent:
    """Descent by the renderer that is `chosen`; threads are the CPU's. Raises ConfigurationError as that does."""
    return (Descent if chosen().renderer == "cpu" else DeviceDescent)(scene, beta1, beta2, threads)
