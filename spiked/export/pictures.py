"""Pictures of a recording at the poses of a path: spike-aligned rates, short enough that motion does not blur them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.export.source import ExportOptions, ExportSource
from spiked.export.views import RenderedView
from spiked.rates import levels, rate_at, white_of
from spiked.trajectory import Trajectory
from spiked.undistortion import Undistortion

__all__ = ["KeyPicture", "key_pictures"]

LONGEST, SHORTEST = 32, 4
"""Frames of a picture: 1.5 % noise of a bright pixel, and what even fast motion leaves."""
BLUR_PX = 1.0
"""Motion of the image within a picture, at most, unless it would be shorter than `SHORTEST`."""


@dataclass(frozen=True)
class KeyPicture:
    """A picture and where it was taken."""

    view: RenderedView
    pixels: NDArray[np.uint8]
    """[H, W], RGB [H, W, 3] of a mosaic; linear."""
    frames: int
    """That it is made of."""

    @property
    def name(self) -> str:
        """Of its file, within the folder of pictures."""
        return f"{self.view.time_s:.9f}.png"

    def colour(self) -> NDArray[np.uint8]:
        """RGB [H, W, 3], three equal channels of a grey picture: loaders of COLMAP folders take the first three."""
        return self.pixels if self.pixels.ndim == 3 else np.repeat(self.pixels[..., None], 3, axis=2)

    def grey(self) -> NDArray[np.uint8]:
        """[H, W]."""
        return self.pixels if self.pixels.ndim == 2 else np.asarray(np.rint(self.pixels.mean(-1)), np.uint8)


def key_pictures(
    source: ExportSource, options: ExportOptions, views: Iterator[RenderedView] | list[RenderedView]
) -> Iterator[KeyPicture]:
    """The pictures at some views; views whose frames were lost have none. Raises ConfigurationError."""
    recording, white = source.need_recording(), 0.0
    k, lens = source.need_sensor().intrinsics, None
    if options.undistorted and k is not None and k.distortion is not None:
        lens = Undistortion.of(k, recording.sensor.width, recording.sensor.height)
    for view in views:
        frames = picture_frames(source.path, view)
        rate = rate_at(recording, view.time_s, frames, source.first_frame)
        if rate is None:
            continue
        rate = rate if lens is None else lens.straighten(rate)
        rate = rate[..., 0] if rate.shape[2] == 1 else rate
        white = white or white_of(rate)
        yield KeyPicture(view, levels(rate, white), frames)


def picture_frames(path: Trajectory, view: RenderedView) -> int:
    """Frames of the picture at a view, by how fast the image moves there."""
    other = view.row + 1 if view.row + 1 < len(path) else view.row - 1
    frames = abs(path.times_s[other] - view.time_s) if other >= 0 else 0.0
    known = view.depth > 0
    if other < 0 or frames <= 0 or not known.any():
        return LONGEST
    step = max(1, int(known.sum()) // 1000)
    points, pixels = view.points()[known][::step], np.argwhere(known)[::step, ::-1] + 0.5
    moved = view.camera.intrinsics.project((points - path.centres[other]) @ path.rotations[other])
    per_pose = float(np.median(np.linalg.norm(moved - pixels, axis=1)))
    return int(np.clip(BLUR_PX / max(per_pose, 1e-6), SHORTEST, LONGEST))
