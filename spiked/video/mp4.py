"""An MP4 file of H.264, which browsers and players show."""

from collections.abc import Callable
from contextlib import ExitStack, suppress
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError, SceneError
from spiked.whole_files import whole_file

__all__ = ["Mp4Writer"]

QUALITY = 20
"""Constant rate factor of H.264: 0 loses nothing, 18 is hardly told from the source, 51 is the worst."""
LARGEST_PX = 8192
"""Longest side."""
MOST_PICTURES_A_SECOND = 1000
"""Highest rate of a video."""


class Mp4Writer:
    """Writes pictures of one size at a constant rate.

    The file appears under its name when all is written: after an error, or without a picture, there is none, and an
    earlier file stays.
    """

    def __init__(self, path: Path, pictures_a_second: float, *, quality: int = QUALITY) -> None:
        """`quality` as `QUALITY` has it. Raises ConfigurationError for a rate or quality out of range, or without the
        package PyAV, which `pip install 'spiked[video]'` installs."""
        if not 0 < pictures_a_second <= MOST_PICTURES_A_SECOND:
            raise ConfigurationError(
                f"a video has up to {MOST_PICTURES_A_SECOND} pictures a second, not {pictures_a_second:g}"
            )
        if not 0 <= quality <= 51:
            raise ConfigurationError(f"the quality of a video is 0 (best) to 51, not {quality}")
        try:
            self._av: Any = import_module("av")
        except ImportError as error:
            raise ConfigurationError("a video needs the Python package av: pip install 'spiked[video]'") from error
        self._path = path
        self._whole = ExitStack()
        self._rate = Fraction(pictures_a_second).limit_denominator(1000)
        self._quality = quality
        self._file: Any = None
        self._stream: Any = None
        self.pictures = 0
        """Written so far."""

    def __enter__(self) -> Self:
        return self

    def write(self, picture: NDArray[np.uint8]) -> None:
        """Append a picture, uint8 [H, W] or RGB [H, W, 3], values as a display shows them; all of one size.

        An odd row or column at the end is left out: H.264 stores colours for squares of 2 x 2 pixels. Raises SceneError
        for another size than the first, and OSError.
        """
        rgb = np.repeat(picture[..., None], 3, -1) if picture.ndim == 2 else picture
        rgb = np.ascontiguousarray(rgb[: rgb.shape[0] // 2 * 2, : rgb.shape[1] // 2 * 2])
        height, width = rgb.shape[:2]
        if self._stream is None:
            self._begin(width, height)
        if (self._stream.width, self._stream.height) != (width, height):
            raise SceneError(
                f"picture {self.pictures} is {width} x {height}, the first {self._stream.width} x {self._stream.height}"
            )
        frame = self._av.VideoFrame.from_ndarray(rgb, format="rgb24")
        frame.pts = self.pictures
        frame.time_base = 1 / self._rate
        self._checked(lambda: self._file.mux(self._stream.encode(frame)))
        self.pictures += 1

    def _begin(self, width: int, height: int) -> None:
        if not 2 <= width <= LARGEST_PX or not 2 <= height <= LARGEST_PX:
            raise SceneError(f"a video has sides of 2 to {LARGEST_PX} pixels, not {width} x {height}")
        options = {"movflags": "+faststart"}  # a browser shows it before it has all
        part = self._whole.enter_context(whole_file(self._path))
        self._file = self._checked(lambda: self._av.open(str(part), "w", format="mp4", options=options))
        self._whole.push(self._end)
        codec = "libx264" if "libx264" in self._av.codecs_available else "h264"
        self._stream = self._file.add_stream(codec, rate=self._rate, options={"crf": str(self._quality)})
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "yuv420p"
        self._stream.time_base = 1 / self._rate

    def _checked(self, work: Callable[[], Any]) -> Any:
        """Its result. Raises OSError for errors of the disk, and SceneError for others of the encoder."""
        try:
            return work()
        except self._av.error.FFmpegError as error:
            if isinstance(error, OSError) and (error.errno or 0) > 0:
                raise OSError(error.errno, error.strerror, str(self._path)) from error
            raise SceneError(f"{self._path} cannot be encoded: {error}") from error

    def _end(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close the file; after an error it is given up, and what closing says of it no longer matters."""
        if kind is not None:
            with suppress(self._av.error.FFmpegError):
                self._file.close()
            return
        try:
            self._checked(lambda: self._file.mux(self._stream.encode(None)))
        finally:
            self._checked(self._file.close)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._whole.__exit__(kind, error, trace)
