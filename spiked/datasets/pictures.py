"""Scenes of pictures: sizes, order, and the camera scaled to the pictures that are there."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from spiked.datasets.clip import PictureScene
from spiked.datasets.spikes import checked_picture
from spiked.errors import DatasetError
from spiked.natural_order import natural
from spiked.sensor import Intrinsics

SCALE_TOLERANCE_PX = 2.0
"""Pictures scaled down were rounded to whole pixels: their sides may differ so far from the camera's, scaled."""
LEAST_PICTURES = 2
"""Of a scene: a path has at least two poses."""


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture, from its header. Raises DatasetError."""
    opened = oiio.ImageInput.open(str(checked_picture(path)))
    if opened is None:
        raise DatasetError(f"{path}: this is no picture that can be read: {oiio.geterror() or 'unknown format'}")
    spec = opened.spec()
    opened.close()
    return spec.width, spec.height


def make_scene(
    name: str,
    pictures: Sequence[Path],
    rotations: NDArray[np.float64],
    centres: NDArray[np.float64],
    camera: tuple[int, int, Intrinsics],
    *,
    times_s: NDArray[np.float64] | None = None,
    median_depth: float | None = None,
) -> PictureScene:
    """A scene with its pictures in natural order of names, or in that of `times_s` [n] if there are any.

    `rotations` [n, 3, 3] and `centres` [n, 3] are of the pictures; `camera` is width, height and intrinsics as the data
    set states them. Raises DatasetError for missing pictures and for pictures of several sizes.
    """
    if len(pictures) < LEAST_PICTURES:
        raise DatasetError(f"{name}: {len(pictures)} pictures with poses are too few for a path")
    order = sorted(range(len(pictures)), key=lambda k: natural(pictures[k]) if times_s is None else times_s[k])
    ordered = tuple(pictures[k] for k in order)
    size = picture_size(ordered[0])
    for path in ordered[1:]:
        other = picture_size(path)
        if other != size:
            raise DatasetError(
                f"{path} has {other[0]}x{other[1]} pixels and {ordered[0].name} {size[0]}x{size[1]}: "
                "a scene has pictures of one size; separate them"
            )
    intrinsics = _scaled(ordered[0], size, camera)
    times = None if times_s is None else times_s[order]
    if times is not None and not (np.diff(times) > 0).all():
        raise DatasetError(f"{name}: two pictures have the same time; correct the times")
    return PictureScene(name, ordered, rotations[order], centres[order], intrinsics, *size, median_depth, times)


def _scaled(first: Path, size: tuple[int, int], camera: tuple[int, int, Intrinsics]) -> Intrinsics:
    width, height, intrinsics = camera
    if size == (width, height):
        return intrinsics
    factor = size[0] / width
    if abs(height * factor - size[1]) > SCALE_TOLERANCE_PX:
        raise DatasetError(
            f"{first} has {size[0]}x{size[1]} pixels and its camera {width}x{height}: the picture was cropped; "
            "use the pictures that the poses were made of"
        )
    return intrinsics.scaled(factor)
