"""Encodes images as PNG, WebP, JPEG or EXR in memory, with OpenImageIO."""

import os
from enum import StrEnum

import cv2
import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from spiked.errors import ConfigurationError


class ImageFormat(StrEnum):
    """What a picture is encoded as: 8 bits a channel, a value divided by the white given and clipped, or floats."""

    PNG = "png"
    WEBP = "webp"
    JPEG = "jpeg"
    """Without alpha."""
    EXR = "exr"
    """32-bit floats, values as they are: radiance in expected spikes a frame, depth in the scene's unit of length."""

    @property
    def media_type(self) -> str:
        """Media type."""
        return "image/x-exr" if self is ImageFormat.EXR else f"image/{self}"

    @classmethod
    def accepted(cls, accept: str) -> "ImageFormat | None":
        """The preferred format of an HTTP Accept header; PNG for `*/*`, None if no format is accepted."""
        accepted = []
        for part in accept.split(","):
            kind, *parameters = (word.strip() for word in part.split(";"))
            quality = next((p[2:] for p in parameters if p.startswith("q=")), "1")
            try:
                accepted.append((float(quality), kind))
            except ValueError:
                continue
        for weight, kind in sorted(accepted, key=lambda entry: -entry[0]):
            for one in cls:
                if weight > 0 and kind in (one.media_type, "image/*", "*/*"):
                    return one
        return None


_THUMBNAIL_WIDTH = 200
"""Pixels."""
_WRITERS: dict[ImageFormat, tuple[str, dict[str, str | int]]] = {
    # The fastest settings of zlib and WebP: 2 to 4 ms for 400x250; the defaults take 14 and 36 ms.
    ImageFormat.PNG: ("png", {"png:compressionLevel": 1}),
    ImageFormat.WEBP: ("webp", {"Compression": "webp:85", "webp:method": 1}),
    ImageFormat.JPEG: ("jpeg", {"Compression": "jpeg:90"}),
    ImageFormat.EXR: ("openexr", {"Compression": "zip"}),
}


def encode(image: NDArray[np.float32], kind: ImageFormat, white: float) -> bytes:
    """Encode an image [H, W] or [H, W, C], C 1 or 3; `white` is the value of 255 in all but EXR.

    Raises ConfigurationError.
    """
    pixels = np.ascontiguousarray(image[..., None] if image.ndim == 2 else image, np.float32)
    if kind is ImageFormat.EXR:
        return _written(pixels, kind)
    # Converted here, because OpenImageIO takes four times as long to convert floats.
    levels = np.clip(np.nan_to_num(pixels) * np.float32(255 / max(white, 1e-9)) + np.float32(0.5), 0, 255)
    pixels = levels.astype(np.uint8)
    if kind is ImageFormat.WEBP and pixels.shape[2] == 1:
        pixels = np.repeat(pixels, 3, axis=2)  # WebP has no grey images
    return _written(pixels, kind)


def _written(pixels: NDArray[np.float32] | NDArray[np.uint8], kind: ImageFormat) -> bytes:
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, str(pixels.dtype).replace("float32", "float"))
    name, attributes = _WRITERS[kind]
    for attribute, value in attributes.items():
        spec.attribute(attribute, value)
    # The Python interface of OpenImageIO writes to paths only: the path of a file in memory.
    file = os.memfd_create(f"spiked.{kind}")
    try:
        writer = oiio.ImageOutput.create(name)
        if writer is None:
            raise ConfigurationError(f"this OpenImageIO cannot write {kind} images: {oiio.geterror()}")
        if not (writer.open(f"/proc/self/fd/{file}", spec) and writer.write_image(pixels) and writer.close()):
            raise ConfigurationError(f"the image could not be encoded as {kind}: {writer.geterror()}")
        return os.pread(file, os.fstat(file).st_size, 0)
    finally:
        os.close(file)


def thumbnail(picture: NDArray[np.float32]) -> bytes:
    """A WebP of an image [H, W, C], 200 pixels wide."""
    size = (_THUMBNAIL_WIDTH, max(1, _THUMBNAIL_WIDTH * picture.shape[0] // picture.shape[1]))
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.float32)
    return encode(small, ImageFormat.WEBP, display_white(small))


def display_white(image: NDArray[np.float32]) -> float:
    """The radiance shown as white: the 99.5th percentile."""
    return max(float(np.percentile(np.nan_to_num(image), 99.5)), 1e-6)
