"""A scene of Gaussians, and the PLY file with the fields that 3D Gaussian splatting tools expect."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError, SceneError
from spiked.harmonics import COEFFICIENTS, degree_of, harmonic_basis
from spiked.ply_header import ply_header

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Scene", "unit_quats"]

Array = NDArray[np.float32]

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""

_ARRAYS = "means", "quats", "log_scales", "opacity_logits", "colours"
"""Names of `Scene.arrays`."""

_KINDS = {
    "char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "<i2", "ushort": "<u2", "int16": "<i2",
    "uint16": "<u2", "int": "<i4", "uint": "<u4", "int32": "<i4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip


@dataclass
class Scene:
    """N Gaussians as float32 arrays, C-contiguous."""

    means: Array
    """World positions in the trajectory's length unit, [N, 3]."""
    quats: Array
    """Rotations, wxyz, of any length; a zero quaternion counts as no rotation. [N, 4]"""
    log_scales: Array
    """Natural logarithms of the standard deviations along the axes of each Gaussian, [N, 3]."""
    opacity_logits: Array
    """Opacity is 1 / (1 + exp(-logit)), [N]."""
    colours: Array
    """Radiance in expected spikes a frame, not clamped, [N, C] with C = 1 (grey) or 3."""
    white: float | None = None
    """Radiance that is shown as white. None: the colours are those of a display, 1 is white, and their radiance is not
    known; so it is in a PLY that other programs wrote."""
    harmonics: Array | None = None
    """Radiance by direction, in the unit of `colours`: coefficients of spherical harmonics beyond the constant one,
    [N, K, C] with K = 3, 8 or 15 (`spiked.harmonics`). Scenes of other programs have them; rasterisers ignore them, see
    `seen_from`."""

    def __len__(self) -> int:
        return len(self.means)

    @classmethod
    def empty(cls, channels: int) -> "Scene":
        """A scene without Gaussians."""
        shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, channels))
        return _scene((np.zeros(shape, np.float32) for shape in shapes), None)

    @property
    def colour_of_white(self) -> float:
        """The value of `colours` that is shown as white."""
        return 1.0 if self.white is None else self.white

    def arrays(self) -> tuple[Array, Array, Array, Array, Array]:
        """The five arrays in the order of the fields."""
        return self.means, self.quats, self.log_scales, self.opacity_logits, self.colours

    @property
    def opacities(self) -> NDArray[np.float64]:
        """From 0 to 1, [N]."""
        return np.asarray(1 / (1 + np.exp(-self.opacity_logits.astype(np.float64))))

    @property
    def well_formed(self) -> bool:
        """Whether the arrays have the shapes of the fields."""
        means, quats, log_scales, opacity_logits, colours = (array.shape for array in self.arrays())
        n = len(self)
        return (means, quats, log_scales, opacity_logits) == ((n, 3), (n, 4), (n, 3), (n,)) and colours in (
            (n, 1),
            (n, 3),
        )

    def to_torch(self) -> "dict[str, Tensor]":
        """Copies of the five arrays as float32 tensors on the CPU, by the names of the fields, for
        `spiked.render.torch.render`. Raises ConfigurationError without torch (extra `spiked[torch]`)."""
        try:
            import torch
        except ImportError as error:
            raise ConfigurationError("torch is not installed: pip install 'spiked[torch]'") from error
        return {name: torch.tensor(array) for name, array in zip(_ARRAYS, self.arrays(), strict=True)}

    @classmethod
    def from_torch(cls, tensors: "Mapping[str, Tensor]", white: float | None = None) -> "Scene":
        """The scene of tensors as `to_torch` gives them, of any type and device. Raises SceneError for others."""
        missing = [name for name in _ARRAYS if name not in tensors]
        if missing:
            raise SceneError(f"a scene needs the tensors {', '.join(_ARRAYS)}: {', '.join(missing)} not given")
        scene = _scene(
            (np.array(tensors[name].detach().cpu().numpy(), np.float32, order="C") for name in _ARRAYS), white
        )
        if not scene.well_formed:
            shapes = ", ".join(str(array.shape) for array in scene.arrays())
            raise SceneError(f"tensors of shapes {shapes} are no scene: see spiked.scene.Scene")
        if not all(np.isfinite(array).all() for array in scene.arrays()):
            raise SceneError("the tensors hold values that are not finite")
        return scene

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "Scene":
        """The Gaussians at `rows`, copied."""
        some = _scene((np.ascontiguousarray(array[rows]) for array in self.arrays()), self.white)
        return some if self.harmonics is None else replace(some, harmonics=self.harmonics[rows])

    def join(self, other: "Scene") -> "Scene":
        """These Gaussians followed by those of `other`; where one scene has harmonics, the other's are 0. White is the
        brighter one of the two."""
        pairs = zip(self.arrays(), other.arrays(), strict=True)
        whites = [one.white for one in (self, other) if one.white is not None]
        both = _scene((np.concatenate(pair) for pair in pairs), max(whites, default=None))
        count = COEFFICIENTS[max(self.degree, other.degree)]
        if not count:
            return both
        return replace(both, harmonics=np.concatenate([one.filled_harmonics(count) for one in (self, other)]))

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return degree_of(self.harmonics)

    def filled_harmonics(self, count: int) -> Array:
        """The first `count` coefficients, [N, count, C]; 0 where there are fewer."""
        filled = np.zeros((len(self), count, self.colours.shape[1]), np.float32)
        if self.harmonics is not None:
            filled[:, : self.harmonics.shape[1]] = self.harmonics[:, :count]
        return filled

    def seen_from(self, centre: NDArray[np.float64]) -> "Scene":
        """The scene with the colours that a camera at `centre` [3] sees, without harmonics; itself if it has none."""
        if self.harmonics is None:
            return self
        directions = self.means.astype(np.float64) - centre
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        basis = harmonic_basis(directions)[:, : self.harmonics.shape[1]].astype(np.float32)
        colours = self.colours + np.einsum("nk,nkc->nc", basis, self.harmonics)
        return replace(self, colours=np.maximum(colours, 0).astype(np.float32), harmonics=None)

    def write_ply(self, path: Path | str, white: float | None = None, notes: Iterable[str] = ()) -> None:
        """Write a binary PLY with the standard 3DGS fields; see `ply`."""
        Path(path).write_bytes(self.ply(white, notes))

    def ply(self, white: float | None = None, notes: Iterable[str] = ()) -> bytes:
        """The bytes of the PLY file; radiance `white`, the scene's own if None, becomes colour 1 and is noted in it.

        `notes` become further comments.
        """
        white = self.white if white is None else white
        rgb = np.broadcast_to(self.colours, (len(self), 3)) / (white or 1)
        rest = self.filled_harmonics(COEFFICIENTS[self.degree]) / (white or 1)
        rest = np.broadcast_to(rest, (*rest.shape[:2], 3)).swapaxes(1, 2).reshape(len(self), 3 * rest.shape[1])
        names = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        names += [*(f"f_rest_{number}" for number in range(rest.shape[1])), "opacity"]
        names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
        comments = [*([] if white is None else [f"radiance {white!r} spikes per frame is colour 1"]), *notes]
        head = ply_header([("vertex", len(self), [f"float {name}" for name in names])], comments)
        quats = self.quats / np.maximum(np.linalg.norm(self.quats, axis=1, keepdims=True), 1e-12)
        columns = [self.means, np.zeros_like(self.means), (rgb - 0.5) / SH_C0, rest, self.opacity_logits[:, None]]
        body = np.concatenate([*columns, self.log_scales, quats], 1).astype("<f4")
        return head + body.tobytes()

    def sample(self, count: int) -> "Scene":
        """At most `count` Gaussians in their order: a fixed sample, which stays much the same while the scene grows."""
        if len(self) <= count:
            return self
        # Multiples of the golden ratio spread evenly, so that the lowest ones are spread evenly over the rows too.
        lot = (np.arange(len(self), dtype=np.uint64) * np.uint64(2654435769)) & np.uint64(0xFFFFFFFF)
        return self.select(np.sort(np.argpartition(lot, count)[:count]))

    @classmethod
    def read_ply(cls, path: Path | str) -> "Scene":
        """Read a 3DGS PLY. View-dependent colour (f_rest) becomes `harmonics`; a `radiance` comment written by us is
        undone and kept as `white`; equal red, green and blue read as one channel.

        Raises SceneError for anything that is not such a file.
        """
        try:
            raw = Path(path).read_bytes()
        except OSError as error:
            raise SceneError(f"cannot read scene {path}: {error.strerror}") from error
        names, count, white, start = _parse_header(raw, path)
        table = np.frombuffer(raw, np.dtype(names), count, start)

        def pick(*fields: str) -> Array:
            missing = [field for field in fields if field not in (table.dtype.names or ())]
            if missing:
                raise SceneError(f"{path} has no property {missing[0]!r}; it is not a 3D Gaussian scene")
            return np.stack([table[field] for field in fields], 1).astype(np.float32)

        rgb = (0.5 + SH_C0 * pick("f_dc_0", "f_dc_1", "f_dc_2")) * np.float32(white or 1)
        harmonics = None
        if rest := _rest_fields([name for name, _ in names], path):
            harmonics = pick(*rest).reshape(count, 3, -1).swapaxes(1, 2) * np.float32(white or 1)
        grey = bool(np.all(rgb == rgb[:, :1])) and (harmonics is None or bool(np.all(harmonics == harmonics[..., :1])))
        if grey and harmonics is not None:
            harmonics = harmonics[..., :1]
        scene = cls(
            pick("x", "y", "z"),
            pick("rot_0", "rot_1", "rot_2", "rot_3"),
            pick("scale_0", "scale_1", "scale_2"),
            pick("opacity")[:, 0].copy(),
            np.ascontiguousarray(rgb[:, :1] if grey else rgb),
            white,
            None if harmonics is None else np.ascontiguousarray(harmonics),
        )
        if not all(
            np.isfinite(array).all()
            for array in (*scene.arrays(), scene.harmonics if scene.harmonics is not None else scene.means)
        ):
            raise SceneError(f"{path} holds values that are not finite")
        return scene


def unit_quats(quats: Array) -> NDArray[np.float64]:
    """Quaternions [N, 4] of length 1; zero ones count as no rotation, 1, 0, 0, 0."""
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(lengths > 0, quats / np.maximum(lengths, 1e-30), [1.0, 0.0, 0.0, 0.0]).astype(np.float64)


def _scene(arrays: Iterable[Array], white: float | None) -> Scene:
    means, quats, log_scales, opacity_logits, colours = arrays
    return Scene(means, quats, log_scales, opacity_logits, colours, white)


def _parse_header(raw: bytes, path: Path | str) -> tuple[list[tuple[str, str]], int, float | None, int]:
    """Property names with types, number of vertices, radiance of colour 1 if stated, and where the data begin."""
    mark = b"end_header\n"
    end = raw.find(mark)
    if not raw.startswith(b"ply") or end < 0:
        raise SceneError(f"{path} is not a PLY file")
    names: list[tuple[str, str]] = []
    count, element, form = 0, "", ""
    white: float | None = None
    for line in raw[:end].decode("latin-1").splitlines():
        words = line.split()
        match words:
            case ["format", form, *_]:
                pass
            case ["comment", "radiance", value, *_]:
                white = _radiance(value, path)
            case ["element", element, number]:
                if not number.isdecimal() or len(number) > 18:
                    raise SceneError(f"{path}: its header has {number!r} of {element}, which is no number")
                if element == "vertex":
                    count = int(number)
                elif int(number) and not names:
                    raise SceneError(f"{path}: its first element is {element}, and that of splats is vertex")
            case ["property", "list", *_] if element == "vertex":
                raise SceneError(f"{path}: its vertices have a list, which splats have not")
            case ["property", kind, name] if element == "vertex":
                if kind not in _KINDS:
                    raise SceneError(f"{path}: property {name} has unknown type {kind}")
                if name in dict(names):
                    raise SceneError(f"{path}: its header has the property {name} twice")
                names.append((name, _KINDS[kind]))
            case _:
                pass
    if form != "binary_little_endian":
        raise SceneError(f"{path} is a PLY of format {form or 'unknown'}; only binary_little_endian is read")
    start = end + len(mark)
    need = count * np.dtype(names).itemsize if names else 0
    if len(raw) - start < need:
        raise SceneError(f"{path} is cut short: {count} Gaussians need {need} bytes, {len(raw) - start} are there")
    return names, count, white, start


def _rest_fields(names: list[str], path: Path | str) -> list[str]:
    """The fields of view-dependent colour in their order, channel by channel. Raises SceneError for another number."""
    count = sum(name.startswith("f_rest_") for name in names)
    if count % 3 or count // 3 not in COEFFICIENTS:
        raise SceneError(f"{path} has {count} fields f_rest_*, and 9, 24 or 45 make degrees 1, 2 and 3")
    return [f"f_rest_{number}" for number in range(count)]


def _radiance(text: str, path: Path | str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < np.inf:
        raise SceneError(f"{path}: the radiance of colour 1 in its header is {text!r}; it must be a positive number")
    return value
