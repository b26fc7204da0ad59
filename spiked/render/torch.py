"""The rasterisers and losses as differentiable operators of torch (extra `spiked[torch]`), for a loss or an
optimiser of one's own; `examples/own_loss.py` trains a scene.

    splats = {name: tensor.requires_grad_() for name, tensor in scene.to_torch().items()}
    image = render(camera, splats, rotations, centres).values
    loss(image).backward()  # gradients in splats, rotations and centres

The operators are `torch.ops.spiked.render`, `render_backward`, `charge_loss` and `dssim`. They have shapes for
torch.compile and torch.export, and work in float32: tensors of other types are converted, and gradients come back in
the type of what they are of. `render` takes tensors on the CPU, or all on a GPU, where our CUDA kernels render (they go
through main memory); the losses work on the CPU. Second derivatives do not exist.
"""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spiked.distortion import Distortion, LensModel
from spiked.errors import ConfigurationError
from spiked.pose import hat
from spiked.render.camera import Camera
from spiked.render.charge import ChargeLoss
from spiked.render.cpu import Rasteriser
from spiked.render.gpu import GpuRasteriser
from spiked.render.loss import dssim as _dssim
from spiked.scene import Scene
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Sensor

__all__ = ["Rendered", "charge_loss", "dssim", "render"]

KEPT = 4
"""Rasterisers that are kept, with the buffers of their last image: one for each camera in turn."""
SPLATS = "means", "quats", "log_scales", "opacity_logits", "colours"
"""Names of the tensors of a scene, those of `Scene.to_torch`."""
LENSES = tuple(LensModel)

_Array = NDArray[np.float32]


class Rendered(NamedTuple):
    """What `RenderedImage` has, as tensors, float32. Only `values` has gradients."""

    values: Tensor
    """[H, W] for one colour or a mosaic, else [H, W, 3]."""
    alpha: Tensor
    """[H, W]"""
    depth: Tensor
    """[H, W]"""


def render(
    camera: Camera,
    splats: Mapping[str, Tensor],
    rotations: Tensor,
    centres: Tensor,
    *,
    weights: Tensor | None = None,
    windows: Tensor | None = None,
    channels: Tensor | None = None,
    background: float | Sequence[float] = 0.0,
    near: float = 0.01,
) -> Rendered:
    """Render splats, tensors of `Scene.to_torch`, at poses rotations [S, 3, 3], camera to world, and centres [S, 3].

    As `Rasteriser.forward`: the sum over the poses with weights [S, H, W], 1/S each without. With windows [2, H, W] as
    `Rasteriser.forward_moving`: the camera moves from pose to pose, and each pixel looks for a time of its own. With
    channels [H, W] of 0, 1, 2 each pixel has one colour, as behind a mosaic.

    There are gradients by the splats and the poses. That by a rotation lies in the tangent of the rotations, as
    matrices near them that are none have no image: give rotations as functions of what is optimised, for instance
    torch.linalg.matrix_exp. Raises ConfigurationError for shapes that do not fit, for tensors on several devices, and
    where no GPU can render.
    """
    missing = [name for name in SPLATS if name not in splats]
    if missing:
        raise ConfigurationError(f"splats lack {', '.join(missing)}: they are what Scene.to_torch() gives")
    if weights is not None and windows is not None:
        raise ConfigurationError("a camera stands at weighted poses or moves through windows: give one of them")
    ground = [float(value) for value in background] if isinstance(background, Sequence) else [float(background)]
    if len(ground) not in (1, 3):
        raise ConfigurationError(f"the background has {len(ground)} radiances: give one, or one for each of 3 colours")
    size = camera.width, camera.height
    tensors = tuple(splats[name] for name in SPLATS)
    _on_one_device(*tensors, rotations, centres, weights, windows, channels)
    return Rendered(
        *_render(*tensors, rotations, centres, weights, windows, channels, ground, _optics(camera), *size, near)
    )


def charge_loss(
    image: Tensor,
    sensor: Sensor,
    frames: Tensor,
    displacements: Tensor,
    gain: Tensor,
    dark: Tensor | None = None,
    *,
    floor: float,
    pixel: int = 1,
    every: int = 1,
    phase: int = 0,
    jitter: float = 0.02,
) -> Tensor:
    """The loss of `ChargeLoss` of an image in spikes a frame against stored frames uint8 [n, frame_bytes], a scalar.

    Arguments are those of `ChargeLoss.__call__`; the gradient is by the image. Raises ConfigurationError.
    """
    _on_cpu(image, frames, displacements, gain, dark)
    layout = [sensor.width, sensor.height, int(sensor.flipped), int(sensor.bit_order is BitOrder.MSB)]
    layout.append(int(sensor.layout is Layout.ROW_TAGGED))
    mosaic = "" if sensor.mosaic is None else str(sensor.mosaic)
    counts = [pixel, every, phase]
    loss: Tensor = _charge_loss(image, frames, displacements, gain, dark, layout, mosaic, counts, floor, jitter)[0]
    return loss


def dssim(rendered: Tensor, target: Tensor, white: float = 1.0) -> Tensor:
    """1 - mean SSIM of images [H, W] or [H, W, C], as `spiked.render.loss.dssim`: a scalar.

    The gradient is by rendered. Raises ConfigurationError for shapes that do not fit.
    """
    _on_cpu(rendered, target)
    loss: Tensor = _dssim_op(rendered, target, white)[0]
    return loss


@torch.library.custom_op("spiked::render", mutates_args=())
def _render(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    colours: Tensor,
    rotations: Tensor,
    centres: Tensor,
    weights: Tensor | None,
    windows: Tensor | None,
    channels: Tensor | None,
    background: Sequence[float],
    optics: Sequence[float],
    width: int,
    height: int,
    near: float,
) -> tuple[Tensor, Tensor, Tensor]:
    given = _Given(means, quats, log_scales, opacity_logits, colours, rotations, centres, weights, windows, channels)
    kept = _kept(_View(tuple(optics), width, height, near, means.device.type))
    with kept.lock:
        made = kept.forward(given, background)
    values, alpha, depth = (torch.from_numpy(array).to(means.device) for array in made)
    return values, alpha, depth


@_render.register_fake
def _(*given: Any) -> tuple[Tensor, Tensor, Tensor]:
    colours, channels, (width, height) = given[4], given[9], given[12:14]
    shape = (height, width) if colours.shape[1] == 1 or channels is not None else (height, width, 3)
    sizes = shape, (height, width), (height, width)
    values, alpha, depth = (colours.new_empty(size, dtype=torch.float32) for size in sizes)
    return values, alpha, depth


@torch.library.custom_op("spiked::render_backward", mutates_args=())
def _render_backward(
    slope: Tensor,
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    colours: Tensor,
    rotations: Tensor,
    centres: Tensor,
    weights: Tensor | None,
    windows: Tensor | None,
    channels: Tensor | None,
    background: Sequence[float],
    optics: Sequence[float],
    width: int,
    height: int,
    near: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    given = _Given(means, quats, log_scales, opacity_logits, colours, rotations, centres, weights, windows, channels)
    kept = _kept(_View(tuple(optics), width, height, near, means.device.type))
    with kept.lock:
        if not kept.holds(given, background):
            kept.forward(given, background)
        slopes = kept.rasteriser.backward(_array(slope))
    # In the tangent: the derivative along [phi]x R is rotation . phi.
    turned = 0.5 * hat(slopes.rotation) @ np.asarray(rotations.detach().cpu().numpy(), np.float64)
    by = zip((*slopes.arrays(), turned, slopes.centre), given[:7], strict=True)
    a, b, c, d, e, f, g = (torch.from_numpy(array).to(tensor) for array, tensor in by)
    return a, b, c, d, e, f, g


@_render_backward.register_fake
def _(slope: Tensor, *given: Any) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in given[:7])


def _keep_inputs(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs[:10])
    ctx.settings = inputs[10:]
    ctx.mark_non_differentiable(*output[1:])


def _differentiate(ctx: Any, slope: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
    return *_render_backward(slope, *ctx.saved_tensors, *ctx.settings), *(None,) * 8


_render.register_autograd(_differentiate, setup_context=_keep_inputs)


@torch.library.custom_op("spiked::charge_loss", mutates_args=())
def _charge_loss(
    image: Tensor,
    frames: Tensor,
    displacements: Tensor,
    gain: Tensor,
    dark: Tensor | None,
    layout: Sequence[int],
    mosaic: str,
    counts: Sequence[int],
    floor: float,
    jitter: float,
) -> tuple[Tensor, Tensor]:
    width, height, flipped, msb, tagged = layout
    sensor = Sensor(
        width,
        height,
        1.0,  # the loss knows frames, not seconds
        Layout.ROW_TAGGED if tagged else Layout.COMPACT,
        BitOrder.MSB if msb else BitOrder.LSB,
        bool(flipped),
        Mosaic(mosaic) if mosaic else None,
    )
    pixel, every, phase = counts
    loss = ChargeLoss(sensor)(
        _array(image),
        frames.numpy(),
        _array(displacements),
        _array(gain),
        None if dark is None else _array(dark),
        pixel=pixel,
        every=every,
        phase=phase,
        floor=floor,
        jitter=jitter,
    )
    return torch.tensor(loss.loss, dtype=image.dtype), torch.from_numpy(loss.slope).to(image.dtype)


@torch.library.custom_op("spiked::dssim", mutates_args=())
def _dssim_op(rendered: Tensor, target: Tensor, white: float) -> tuple[Tensor, Tensor]:
    loss, slope = _dssim(_array(rendered), target=_array(target), white=white)
    return torch.tensor(loss, dtype=rendered.dtype), torch.from_numpy(slope).to(rendered.dtype)


def _fake_loss(image: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return image.new_empty(()), torch.empty_like(image, memory_format=torch.contiguous_format)


def _keep_slope(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    ctx.save_for_backward(output[1])
    ctx.arguments = len(inputs)
    ctx.mark_non_differentiable(output[1])


def _chain(ctx: Any, slope: Tensor, _: Any) -> tuple[Tensor | None, ...]:
    return slope * ctx.saved_tensors[0], *(None,) * (ctx.arguments - 1)


for _operator in (_charge_loss, _dssim_op):
    _operator.register_fake(_fake_loss)
    _operator.register_autograd(_chain, setup_context=_keep_slope)


class _Given(NamedTuple):
    """The tensors of a render."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    colours: Tensor
    rotations: Tensor
    centres: Tensor
    weights: Tensor | None
    windows: Tensor | None
    channels: Tensor | None

    def versions(self) -> list[tuple[Any, ...] | None]:
        """What tells these tensors, as they are now, from others that are alive at the same time."""
        return [None if t is None else (t.data_ptr(), _version(t), t.shape, t.stride(), t.dtype) for t in self]


class _View(NamedTuple):
    """What a rasteriser is for."""

    optics: tuple[float, ...]
    """fx, fy, cx, cy, and through a lens its number in `LENSES` and its coefficients."""
    width: int
    height: int
    near: float
    device: str
    """cpu or cuda."""

    def rasteriser(self) -> Rasteriser:
        """One for it."""
        lens = self.optics[4:]
        bent = Distortion(LENSES[int(lens[0])], tuple(lens[1:])) if lens else None
        fx, fy, cx, cy = self.optics[:4]
        camera = Camera(Intrinsics(fx, fy, cx, cy, bent), self.width, self.height)
        return Rasteriser(camera, near=self.near) if self.device == "cpu" else GpuRasteriser(camera, self.near)


@dataclass
class _Kept:
    """A rasteriser, and the tensors of its last image: it differentiates that without rendering it again."""

    rasteriser: Rasteriser
    lock: Lock
    """Held while it is used; autograd may run in threads."""
    last: tuple[_Given, list[Any], Sequence[float]] | None = None
    """The tensors are kept, so that no others can be where they were."""

    def forward(self, given: _Given, background: Sequence[float]) -> tuple[_Array, _Array, _Array]:
        """Render."""
        means, quats, log_scales, opacity_logits, colours = (_array(tensor) for tensor in given[:5])
        scene = Scene(means, quats, log_scales, opacity_logits, colours)
        poses = given.rotations.detach().cpu().numpy(), given.centres.detach().cpu().numpy()
        channels = None if given.channels is None else given.channels.cpu().numpy()
        self.last = None
        ground = tuple(background)
        if given.windows is not None:
            windows = _array(given.windows)
            made = self.rasteriser.forward_moving(scene, *poses, windows, channels=channels, background=ground)
        else:
            weights = None if given.weights is None else _array(given.weights)
            made = self.rasteriser.forward(scene, *poses, weights=weights, channels=channels, background=ground)
        self.last = given, given.versions(), list(background)
        return made.values, made.alpha, made.depth

    def holds(self, given: _Given, background: Sequence[float]) -> bool:
        """Whether the last image was of these tensors as they are."""
        if self.last is None:
            return False
        _, versions, ground = self.last
        return versions == given.versions() and list(background) == ground


_POOL: OrderedDict[_View, _Kept] = OrderedDict()
_POOL_LOCK = Lock()


def _kept(view: _View) -> _Kept:
    """The rasteriser for a view; the one that was used longest ago goes when there are more than `KEPT`."""
    with _POOL_LOCK:
        if view not in _POOL:
            _POOL[view] = _Kept(view.rasteriser(), Lock())
            while len(_POOL) > KEPT:
                _POOL.popitem(last=False)
        _POOL.move_to_end(view)
        return _POOL[view]


def _optics(camera: Camera) -> list[float]:
    k = camera.intrinsics
    lens = () if k.distortion is None else (LENSES.index(k.distortion.model), *k.distortion.coefficients)
    return [float(value) for value in (k.fx, k.fy, k.cx, k.cy, *lens)]


def _version(tensor: Tensor) -> int:
    """How often it was changed; nothing is differentiated of an inference tensor, which does not count."""
    return 0 if tensor.is_inference() else tensor._version


def _array(tensor: Tensor) -> _Array:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), np.float32)


def _on_cpu(*tensors: Tensor | None) -> None:
    for tensor in tensors:
        if tensor is not None and tensor.device.type != "cpu":
            raise ConfigurationError(
                f"a tensor is on {tensor.device}: the losses work on the CPU, so give tensor.cpu(); "
                "autograd carries gradients back"
            )


def _on_one_device(*tensors: Tensor | None) -> None:
    """Raises ConfigurationError for tensors on different devices, or on one that does not render."""
    devices = {tensor.device.type for tensor in tensors if tensor is not None}
    if len(devices) > 1 or not devices <= {"cpu", "cuda"}:
        raise ConfigurationError(f"tensors are on {', '.join(sorted(devices))}: give all on the CPU, or all on a GPU")
