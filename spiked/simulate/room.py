"""The built-in scene: a furnished room, textured everywhere, drawn by exact ray casting with filtered textures.

Lengths are metres; x goes to the right, y into the room and z up from the floor. `native/simulate/room.cpp` draws it:
one ray a pixel against the boxes, the mean of the texture over the pixel's footprint from a pyramid of halved pictures,
and sixteen rays in each pixel where two surfaces meet. So pictures are free of aliasing and depth is exact.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

import spiked.native._simulate as _simulate
from spiked.deprecation import renamed_attributes
from spiked.sensor import Intrinsics
from spiked.simulate.motion import Stage
from spiked.simulate.textures import Material, paint
from spiked.simulate.view import LUMINANCE, View

_SIZE = (6.0, 5.0, 2.8)
"""Width, depth and height of the room, metres."""
_LAMP = np.array([3.4, 2.2, 2.6])
_START = np.array([3.1, 0.75, 1.55])
_TARGET = np.array([3.0, 4.0, 1.15])

_WHITE, _OAK, _RED = (0.75, 0.72, 0.66), (0.52, 0.36, 0.22), (0.55, 0.27, 0.19)
"""Albedos, linear."""
_BLUE, _GREEN, _DARK = (0.25, 0.36, 0.55), (0.33, 0.50, 0.28), (0.16, 0.12, 0.10)
"""Albedos, linear."""


@dataclass(frozen=True)
class _Block:
    """A box of the room; one material all around unless its front (-y) differs."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    material: Material
    colour: tuple[float, float, float]
    yaw_deg: float = 0.0
    front: Material | None = None


def _table(x: float, y: float, yaw_deg: float) -> list[_Block]:
    """A table 1.3 x 0.75 x 0.74 with four legs."""
    cos, sin = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    blocks = [_Block((x, y, 0.72), (1.3, 0.75, 0.05), Material.WOOD, _OAK, yaw_deg)]
    for along in (-0.58, 0.58):
        for across in (-0.31, 0.31):
            at = (x + cos * along - sin * across, y + sin * along + cos * across, 0.35)
            blocks.append(_Block(at, (0.07, 0.07, 0.7), Material.WOOD, _DARK, yaw_deg))
    return blocks


_CARD = (3.2, 1.5, 1.47)
"""Centre of a card: 0.75 m in front of the start."""
_CARD_THICK_M = 0.006
"""Of its board."""


@dataclass(frozen=True)
class Card:
    """A printed card, upright in front of the camera: tags and boards of known size."""

    picture: NDArray[np.float32]
    """Albedo, 0 to 1, [rows, columns], the top row first."""
    width_m: float

    @property
    def size(self) -> tuple[float, float, float]:
        """Width, thickness and height, metres."""
        rows, columns = self.picture.shape
        return self.width_m, _CARD_THICK_M, self.width_m * rows / columns


_FURNITURE = [
    *_table(3.4, 2.75, 18.0),
    _Block((3.15, 2.7, 0.84), (0.28, 0.2, 0.18), Material.CLOTH, _RED, 40.0),
    _Block((3.75, 2.95, 0.90), (0.16, 0.16, 0.30), Material.BRICK, _BLUE, 10.0),
    _Block((3.55, 2.55, 0.765), (0.30, 0.22, 0.03), Material.PICTURE, _WHITE, -20.0),
    _Block((1.0, 4.75, 0.95), (1.5, 0.38, 1.9), Material.WOOD, _OAK, 0.0, Material.BOOKS),
    _Block((4.9, 4.35, 0.22), (1.9, 0.85, 0.44), Material.CLOTH, _BLUE),
    _Block((4.9, 4.72, 0.62), (1.9, 0.22, 0.45), Material.CLOTH, _BLUE),
    _Block((4.35, 4.2, 0.53), (0.42, 0.42, 0.16), Material.RUG, _RED, 12.0),
    _Block((5.4, 4.3, 0.55), (0.4, 0.35, 0.2), Material.RUG, _GREEN, -25.0),
    _Block((2.9, 2.6, 0.01), (2.9, 1.9, 0.02), Material.RUG, _RED, 4.0),
    _Block((0.45, 2.4, 0.4), (0.6, 1.1, 0.8), Material.WOOD, _OAK, 0.0),
    _Block((0.42, 2.2, 1.0), (0.3, 0.4, 0.4), Material.PICTURE, _DARK, 25.0),
    _Block((1.75, 2.3, 0.25), (0.5, 0.45, 0.5), Material.BRICK, _GREEN, 33.0),
    _Block((1.72, 2.28, 0.62), (0.34, 0.3, 0.24), Material.PICTURE, _WHITE, 12.0),
    _Block((5.6, 2.2, 0.5), (0.55, 0.55, 1.0), Material.WOOD, _RED, -15.0),
    _Block((5.6, 2.2, 1.15), (0.3, 0.3, 0.3), Material.BRICK, _WHITE, 20.0),
    _Block((2.75, 4.97, 1.65), (0.95, 0.05, 0.75), Material.PICTURE, _DARK),
    _Block((3.95, 4.97, 1.75), (0.6, 0.05, 0.85), Material.PICTURE, _OAK),
    _Block((5.1, 4.97, 1.7), (0.85, 0.05, 0.6), Material.PICTURE, _DARK),
    _Block((0.03, 3.6, 1.6), (0.05, 1.1, 0.8), Material.PICTURE, _OAK),
    _Block((5.97, 3.3, 1.7), (0.05, 1.3, 0.9), Material.PICTURE, _DARK),
    _Block((3.6, 0.03, 1.6), (1.6, 0.05, 1.0), Material.PICTURE, _OAK),
    _Block((1.2, 0.3, 1.0), (1.2, 0.45, 2.0), Material.WOOD, _OAK, 0.0, Material.BOOKS),
    _Block((5.4, 0.5, 0.5), (0.8, 0.7, 1.0), Material.CLOTH, _GREEN, 8.0),
    _Block((2.1, 3.9, 0.9), (0.12, 0.12, 1.8), Material.CLOTH, _DARK, 30.0),
    _Block((2.1, 3.9, 1.85), (0.4, 0.4, 0.35), Material.RUG, _WHITE, 15.0),
]
_SHELL = (Material.BRICK, Material.PLASTER, Material.PLASTER, Material.BRICK, Material.WOOD, Material.PLASTER)
_SHELL_COLOURS = (_WHITE, _GREEN, _WHITE, _RED, _OAK, _WHITE)


@renamed_attributes(look="render")
class Room:
    """The room as a scene. The seed changes the textures, not the furniture."""

    def __init__(
        self, colour: bool = False, seed: int = 0, texel_m: float = 0.006, threads: int = 1, card: Card | None = None
    ) -> None:
        """colour: three channels instead of one. texel_m: edge of a texture's finest cell in metres."""
        self._threads = threads
        self._channels = 3 if colour else 1
        self._native = _build(seed, self._channels, texel_m, card)

    def stage(self, intrinsics: Intrinsics, flow_px: float = 0.12, parallax: float = 0.1) -> Stage:
        """A good place to start from: facing the far wall over the table."""
        return Stage(_START, _TARGET, np.array([0.0, 0.0, 1.0]), intrinsics.fx, flow_px, parallax)

    def render(
        self,
        intrinsics: Intrinsics,
        width: int,
        height: int,
        rotation: NDArray[np.float64],
        centre: NDArray[np.float64],
    ) -> View:
        """See `ViewableScene.render`."""
        image = np.empty((height, width, self._channels), np.float32)
        depth = np.empty((height, width), np.float32)
        self._native.render(
            np.ascontiguousarray(rotation, np.float64),
            np.ascontiguousarray(centre, np.float64),
            intrinsics.fx,
            intrinsics.fy,
            intrinsics.cx,
            intrinsics.cy,
            image,
            depth,
            self._threads,
        )
        return View(image, depth)


@dataclass
class _Atlas:
    """The pyramids of all surfaces, one after the other."""

    channels: int
    texel_m: float
    entries: list[tuple[int, int, int, int]]
    texels: list[NDArray[np.uint16]]
    texels_a_metre: list[float]
    used: int = 0

    def add(self, radiance: NDArray[np.float32], texel_m: float | None = None) -> int:
        """Store a picture [height, width, 3] with its halved versions; returns its number."""
        level = radiance if self.channels == 3 else radiance @ LUMINANCE[:, None]
        height, width = level.shape[:2]
        offset, levels = self.used, 0
        while True:
            level = level.reshape(*level.shape[:2], self.channels)
            self.texels.append(np.round(np.clip(level, 0, 1) * 65535).astype(np.uint16).ravel())
            self.used += level.shape[0] * level.shape[1]
            levels += 1
            if max(level.shape[:2]) == 1:
                break
            half = (max(level.shape[1] // 2, 1), max(level.shape[0] // 2, 1))
            level = cv2.resize(level, half, interpolation=cv2.INTER_AREA)
        self.entries.append((offset, width, height, levels))
        self.texels_a_metre.append(1 / (texel_m or self.texel_m))
        return len(self.entries) - 1


def _build(seed: int, channels: int, texel_m: float, card: Card | None) -> _simulate.Room:
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x2002]))
    size = np.array(_SIZE)
    atlas = _Atlas(channels, texel_m, [], [], [])
    boxes = [np.concatenate([size / 2, np.eye(3).ravel(), size / 2])]
    faces = [[_face(atlas, boxes[0], f, _SHELL[f], _SHELL_COLOURS[f], rng=rng, outward=-1.0) for f in range(6)]]
    for block in _FURNITURE:
        cos, sin = np.cos(np.radians(block.yaw_deg)), np.sin(np.radians(block.yaw_deg))
        axes = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        box = np.concatenate([block.centre, axes.ravel(), np.array(block.size) / 2])
        materials = [block.front if f == 2 and block.front else block.material for f in range(6)]
        faces.append([_face(atlas, box, f, materials[f], block.colour, rng=rng, outward=1.0) for f in range(6)])
        boxes.append(box)
    if card is not None:
        boxes.append(np.concatenate([_CARD, np.eye(3).ravel(), np.array(card.size) / 2]))
        faces.append([_face(atlas, boxes[-1], f, Material.PLASTER, _WHITE, rng=rng, outward=1.0) for f in range(6)])
        faces[-1][2] = _printed(atlas, boxes[-1], card)
    return _simulate.make_room(
        channels,
        np.array(boxes, np.float32),
        np.array(faces, np.int32),
        np.array(atlas.entries, np.int64),
        np.array(atlas.texels_a_metre, np.float32),
        np.concatenate(atlas.texels),
    )


def _face(
    atlas: _Atlas,
    box: NDArray[np.float64],
    face: int,
    material: Material,
    colour: tuple[float, float, float],
    *,
    rng: np.random.Generator,
    outward: float,
) -> int:
    """Paints one face (-x +x -y +y -z +z) and lights it; the texture's axes are the next two of the box in turn."""
    centre, axes, half = box[:3], box[3:12].reshape(3, 3), box[12:]
    a = face // 2
    u, v = (a + 1) % 3, (a + 2) % 3
    width, height = (max(round(2 * half[i] / atlas.texel_m), 2) for i in (u, v))
    # Upright faces look along z; paint with z as the picture's first axis whichever axis of the texture it is.
    albedo = paint(material, colour, (width, height) if u == 2 else (height, width), atlas.texel_m, rng)
    if u == 2:
        albedo = np.ascontiguousarray(albedo.swapaxes(0, 1))
    normal = axes[a] * (1.0 if face % 2 else -1.0)
    coarse = 24
    along = np.linspace(-1, 1, coarse)
    points = (
        centre + normal * half[a] + along[None, :, None] * half[u] * axes[u] + along[:, None, None] * half[v] * axes[v]
    )
    light = _light(points, normal * outward).astype(np.float32)
    return atlas.add(albedo * cv2.resize(light, (width, height), interpolation=cv2.INTER_LINEAR)[..., None])


def _printed(atlas: _Atlas, box: NDArray[np.float64], card: Card) -> int:
    """The face to -y of a card; the axes of its texture are z, upwards, and x."""
    light = float(_light(box[None, :3], np.array([0.0, -1.0, 0.0]))[0])
    albedo = np.repeat(card.picture[::-1].T[..., None], 3, axis=2)
    return atlas.add(np.ascontiguousarray(light * albedo, np.float32), card.width_m / card.picture.shape[1])


def _light(points: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Irradiance of one lamp near the ceiling and of the light that the walls return; no shadows are cast."""
    to_lamp = _LAMP - points
    squared = (to_lamp**2).sum(-1) + 0.6
    direct = np.maximum(to_lamp @ normal, 0) / np.sqrt(squared) / (1 + 0.16 * squared)
    return np.asarray(0.62 + 0.10 * normal[2] + 0.08 * normal[0] + 0.75 * direct)
