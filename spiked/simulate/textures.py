"""Surfaces for the built-in room, painted from random numbers with detail at every scale from wall to texel."""

from collections.abc import Callable
from enum import Enum, auto

import cv2
import numpy as np
from numpy.typing import NDArray

Albedo = NDArray[np.float32]


class Material(Enum):
    """What a surface is made of."""

    PLASTER = auto()
    WOOD = auto()
    BRICK = auto()
    CLOTH = auto()
    RUG = auto()
    BOOKS = auto()
    PICTURE = auto()


def paint(
    material: Material,
    colour: tuple[float, float, float],
    size: tuple[int, int],
    texel: float,
    rng: np.random.Generator,
) -> Albedo:
    """Albedo float32 [height, width, 3] in [0.02, 0.95]; `size` is (height, width), `texel` its edge in metres."""
    base = np.array(colour, np.float32)
    albedo = _PAINTERS[material](base, size, texel, rng)
    return np.clip(albedo, 0.02, 0.95).astype(np.float32)


def pink_noise(size: tuple[int, int], rng: np.random.Generator, coarsest: float, falloff: float = 0.75) -> Albedo:
    """Noise with octaves from `coarsest` texels down to two, each `falloff` as strong as the one above; std 1.

    The finest octave has two texels a cell, so the texture holds nothing that bilinear sampling would alias.
    """
    out = np.zeros(size, np.float32)
    cell, strength, power = coarsest, 1.0, 0.0
    while cell >= 2:
        grid = rng.standard_normal((int(size[0] / cell) + 4, int(size[1] / cell) + 4), np.float32)
        fine = cv2.resize(grid, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)
        out += strength * fine[int(cell) :, int(cell) :][: size[0], : size[1]]
        power += strength**2
        cell, strength = cell / 2, strength * falloff
    return np.asarray(out / np.float32(np.sqrt(max(power, 1e-9)) * 0.75), np.float32)


def _plaster(base: Albedo, size: tuple[int, int], texel: float, rng: np.random.Generator) -> Albedo:
    stains = pink_noise(size, rng, 0.8 / texel, 0.8)
    hue = np.stack([pink_noise(size, rng, 1.2 / texel, 0.5) for _ in range(3)], -1)
    return np.asarray(base * (1 + 0.20 * stains[..., None] + 0.06 * hue), np.float32)


def _wood(base: Albedo, size: tuple[int, int], texel: float, rng: np.random.Generator) -> Albedo:
    """Planks 0.14 m wide with grain along them."""
    height, width = size
    plank = max(round(0.14 / texel), 4)
    tones = rng.uniform(0.55, 1.35, (height // plank + 2, 1)).astype(np.float32)
    rows = np.arange(height) // plank
    ends = (np.arange(width)[None] + rng.integers(0, 4000, len(tones))[rows][:, None]) // max(round(1.3 / texel), 8)
    tone = tones[rows] * (0.85 + 0.3 * ((ends * 7919 + rows[:, None] * 104729) % 17 / 16).astype(np.float32))
    grain = pink_noise((height, max(width // 8, 2)), rng, 0.06 / texel, 0.9)
    grain = cv2.resize(grain, (width, height), interpolation=cv2.INTER_CUBIC)
    gap = np.where(np.arange(height)[:, None] % plank < max(0.006 / texel, 1), 0.45, 1.0).astype(np.float32)
    knots = pink_noise(size, rng, 0.3 / texel, 0.7)
    shade = tone * gap * (1 + 0.22 * grain + 0.10 * knots)
    return np.asarray(base * _soften(shade)[..., None], np.float32)


def _brick(base: Albedo, size: tuple[int, int], texel: float, rng: np.random.Generator) -> Albedo:
    """A running bond of bricks 0.24 x 0.08 m (along the second axis of the picture)."""
    rows = (np.arange(size[0]) * texel / 0.08)[:, None]
    columns = (np.arange(size[1]) * texel / 0.24)[None] + 0.5 * (np.floor(rows) % 2)
    tones = rng.uniform(0.6, 1.4, (int(rows.max()) + 2, int(columns.max()) + 2)).astype(np.float32)
    tone = tones[np.floor(rows).astype(int), np.floor(columns).astype(int)]
    mortar = (rows % 1 < 0.12) | (columns % 1 < 0.045)
    shade = np.where(mortar, np.float32(1.5), tone) * (1 + 0.18 * pink_noise(size, rng, 0.2 / texel, 0.9))
    tint = np.where(mortar[..., None], base.mean(), base)
    return np.asarray(tint * _soften(shade)[..., None], np.float32)


def _cloth(base: Albedo, size: tuple[int, int], texel: float, rng: np.random.Generator) -> Albedo:
    """Checks with uneven threads."""
    y, x = (np.arange(n, dtype=np.float32) * texel for n in size)
    checks = np.sign(np.sin(2 * np.pi * y / 0.11))[:, None] + np.sign(np.sin(2 * np.pi * x / 0.13))[None]
    shade = 1 + 0.17 * _soften(checks.astype(np.float32)) + 0.25 * pink_noise(size, rng, 0.3 / texel, 0.85)
    return np.asarray(base * shade[..., None], np.float32)


def _rug(base: Albedo, size: tuple[int, int], texel: float, rng: np.random.Generator) -> Albedo:
    """Concentric borders and lozenges in three colours."""
    y = np.abs(np.linspace(-1, 1, size[0], dtype=np.float32))[:, None]
    x = np.abs(np.linspace(-1, 1, size[1], dtype=np.float32))[None]
    border = np.floor(np.maximum(x, y) * 7).astype(int)
    lozenge = np.floor((x + y) * 9).astype(int)
    index = np.where(border >= 5, border, lozenge % 4)
    palette = rng.uniform(0.15, 1.0, (8, 3)).astype(np.float32) * base / base.mean() * 0.6
    shade = 1 + 0.2 * pink_noise(size, rng, 0.25 / texel, 0.9)
    return _soften(palette[index]) * shade[..., None]


def _books(base: Albedo, size: tuple[int, int], texel: float, rng: np.random.Generator) -> Albedo:
    """Shelves along the first axis of the picture, with the spines of books, each of its own tone and height."""
    out = np.empty((*size, 3), np.float32)
    out[:] = 0.05
    shelf, board = max(round(0.33 / texel), 8), max(round(0.025 / texel), 1)
    for low in range(0, size[0], shelf):
        out[low : low + board] = base
        x = 0
        while x < size[1]:
            wide, tall = round(rng.uniform(0.02, 0.06) / texel), round(rng.uniform(0.2, 0.29) / texel)
            spine = out[low + board : min(low + board + tall, low + shelf), x : x + max(wide, 2)]
            tone = rng.uniform(0.1, 0.85) * rng.uniform(0.5, 1.0, 3)
            spine[:] = tone
            title = slice(int(0.55 * len(spine)), int(0.8 * len(spine)))
            spine[title] = 0.9 - 0.8 * tone.mean()
            x += max(wide, 2) + int(rng.random() < 0.08) * 6
    return _soften(out) * (1 + 0.12 * pink_noise(size, rng, 0.1 / texel, 0.9))[..., None]


def _picture(base: Albedo, size: tuple[int, int], texel: float, rng: np.random.Generator) -> Albedo:
    """A framed painting: discs, bars and polygons of high contrast, drawn four times too large and averaged down."""
    fine = 4
    canvas = np.full((size[0] * fine, size[1] * fine, 3), rng.uniform(0.3, 0.7, 3) * 255, np.uint8)
    extent = np.array([canvas.shape[1], canvas.shape[0]])
    for k in range(70):
        tone = (rng.uniform(0.03, 1.0, 3) * rng.choice([0.3, 0.6, 1.0]) * 255).tolist()
        at = rng.uniform(0, 1, 2) * extent
        reach = extent.min() * 0.35 / (1 + 0.12 * k)
        match k % 3:
            case 0:
                cv2.circle(canvas, at.astype(int).tolist(), int(reach / 2) + 2, tone, -1)
            case 1:
                corners = at + rng.uniform(-1, 1, (5, 2)) * reach
                cv2.fillPoly(canvas, [corners.astype(np.int32)], tone)
            case _:
                end = at + rng.uniform(-1.5, 1.5, 2) * reach
                cv2.line(canvas, at.astype(int).tolist(), end.astype(int).tolist(), tone, int(reach / 12) + fine)
    art = cv2.resize(canvas, (size[1], size[0]), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    edge = max(round(0.035 / texel), 1)
    frame = np.ones(size, bool)
    frame[edge:-edge, edge:-edge] = False
    art[frame] = base
    return np.asarray(art * (1 + 0.12 * pink_noise(size, rng, 0.1 / texel, 0.9))[..., None], np.float32)


def _soften(picture: Albedo) -> Albedo:
    """Takes the aliasing off hard steps."""
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.6), np.float32)


_PAINTERS: dict[Material, Callable[[Albedo, tuple[int, int], float, np.random.Generator], Albedo]] = {
    Material.PLASTER: _plaster,
    Material.WOOD: _wood,
    Material.BRICK: _brick,
    Material.CLOTH: _cloth,
    Material.RUG: _rug,
    Material.BOOKS: _books,
    Material.PICTURE: _picture,
}
