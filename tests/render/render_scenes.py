"""Small random scenes for the renderers' tests."""

import numpy as np

from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Intrinsics


def camera(width: int = 45, height: int = 35, focal: float = 40.0) -> Camera:
    return Camera(Intrinsics(focal, focal * 1.05, width / 2 + 0.7, height / 2 - 0.4), width, height)


def splats(count: int, colours: int, seed: int, size: float = 0.06) -> Scene:
    """Splats that fill the view of `camera` from the origin, a few of them beside and behind it."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.8, 3.0, count)
    means = np.stack([rng.uniform(-0.7, 0.7, count) * z, rng.uniform(-0.6, 0.6, count) * z, z], 1)
    means[: count // 10, 2] *= -1
    return Scene(
        means.astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        (np.log(size) + rng.normal(0, 0.6, (count, 3))).astype(np.float32),
        rng.normal(0.3, 1.5, count).astype(np.float32),
        rng.uniform(0.05, 1.0, (count, colours)).astype(np.float32),
    )


def poses(count: int, seed: int, angle: float = 0.05, shift: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Random small rotations [count, 3, 3] and centres [count, 3]."""
    rng = np.random.default_rng(seed)
    rotations = np.stack([turn(rng.normal(0, angle, 3)) for _ in range(count)])
    return rotations, rng.normal(0, shift, (count, 3))


def turn(v: np.ndarray) -> np.ndarray:
    """Exp of a rotation vector by Rodrigues' formula."""
    angle = float(np.linalg.norm(v))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = v / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
