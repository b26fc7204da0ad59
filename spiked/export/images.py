"""Image files of an export: EXR of floats, PNG of 8 or 16 bits."""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from spiked.errors import SceneError

LARGEST = 65535
"""Of 16 bits."""


def write_exr(path: Path, image: NDArray[np.float32], channels: tuple[str, ...]) -> None:
    """Write [H, W] or [H, W, C] as 32-bit floats. Raises OSError and SceneError."""
    path.write_bytes(exr(image, channels))


def exr(image: NDArray[np.float32], channels: tuple[str, ...]) -> bytes:
    """The bytes of an EXR of [H, W] or [H, W, C] as 32-bit floats. Raises SceneError.

    OpenImageIO writes to files only, and its errors do not say that a disk is full: it writes to one in memory.
    """
    pixels = np.ascontiguousarray(image.reshape(*image.shape[:2], -1), np.float32)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "float")
    spec.channelnames = channels
    spec.attribute("Compression", "zip")
    with os.fdopen(os.memfd_create("image.exr"), "rb") as file:
        writer, name = oiio.ImageOutput.create("openexr"), f"/proc/self/fd/{file.fileno()}"
        if writer is None or not (writer.open(name, spec) and writer.write_image(pixels) and writer.close()):
            why = oiio.geterror() or (writer and writer.geterror())
            raise SceneError(f"an image of shape {image.shape} cannot be written as EXR: {why}")
        return file.read()


def read_exr(path: Path) -> NDArray[np.float32]:
    """The floats of an EXR, [H, W, C]. Raises SceneError."""
    pixels = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)
    if pixels is None:
        raise SceneError(f"{path} cannot be read: {oiio.geterror()}")
    return np.asarray(pixels, np.float32)


def write_png(path: Path, image: NDArray[Any]) -> None:
    """Write uint8 or uint16, [H, W] or RGB [H, W, 3]. Raises OSError and SceneError."""
    path.write_bytes(png(image))


def png(image: NDArray[Any]) -> bytes:
    """The bytes of a PNG of uint8 or uint16, [H, W] or RGB [H, W, 3]. Raises SceneError."""
    done, encoded = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not done:
        raise SceneError(f"an image of shape {image.shape} cannot be written as PNG")
    return encoded.tobytes()
