"""Radiance images to PNG and EXR bytes in memory, by OpenImageIO."""

import os
from enum import StrEnum

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from spiked.errors import ConfigurationError


class ImageFormat(StrEnum):
    """What an image is encoded as."""

    PNG = "png"
    """8 bits a channel, radiance divided by the white given and clipped."""
    EXR = "exr"
    """32-bit floats, radiance in expected spikes a frame."""

    @property
    def media_type(self) -> str:
        """Its name in HTTP."""
        return "image/png" if self is ImageFormat.PNG else "image/x-exr"


_WRITERS = {ImageFormat.PNG: "png", ImageFormat.EXR: "openexr"}


def encode(image: NDArray[np.float32], kind: ImageFormat, white: float) -> bytes:
    """Encode radiance [H, W] or [H, W, C], C 1 or 3; `white` is the radiance of PNG's 255.

    Raises ConfigurationError.
    """
    pixels = np.ascontiguousarray(image[..., None] if image.ndim == 2 else image, np.float32)
    if kind is ImageFormat.PNG:
        pixels = np.clip(np.nan_to_num(pixels) / max(white, 1e-9), 0, 1)
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, "uint8" if kind is ImageFormat.PNG else "float")
    # OpenImageIO's Python face writes to names only; the name of a file that lives in memory will do.
    file = os.memfd_create(f"spiked.{kind}")
    try:
        writer = oiio.ImageOutput.create(_WRITERS[kind])
        if writer is None:
            raise ConfigurationError(f"this OpenImageIO cannot write {kind} images: {oiio.geterror()}")
        if not (writer.open(f"/proc/self/fd/{file}", spec) and writer.write_image(pixels) and writer.close()):
            raise ConfigurationError(f"the image could not be encoded as {kind}: {writer.geterror()}")
        return os.pread(file, os.fstat(file).st_size, 0)
    finally:
        os.close(file)


def display_white(image: NDArray[np.float32]) -> float:
    """The radiance to show as white: the 99.5th percentile."""
    return max(float(np.percentile(np.nan_to_num(image), 99.5)), 1e-6)
