"""What to render for a view: poses along the camera's motion during its exposure, or frames to warp."""

from dataclasses import dataclass, field

import numpy as np

from spiked.pose import Array
from spiked.recon.frontend.spike_targets import AdjacentSpikes
from spiked.recon.frontend.windowing import View
from spiked.recon.mapping.frame_warp import FrameWarp
from spiked.render import Camera
from spiked.spline import Path

SUB_FRAME_PX = 3.0
"""Image motion that one sub-frame of straight, blurred motion renders well."""
MAX_SUB_FRAMES = 6
"""Most sub-frames of a view: twelve cost twice as much for the same result (decision 5)."""
PROBE_SHARES = 0.15, 0.5, 0.85
"""Shares of width and height at which image motion is predicted."""
MOTION_PERCENTILE = 75
"""Percentile of the predicted motions that stands for the image."""


@dataclass(frozen=True)
class RenderRequest:
    """What to render for a view: poses, camera to world, along its exposure."""

    rotations: Array
    """[S, 3, 3]"""
    centres: Array
    """[S, 3]"""
    sub_frames: int = 0
    """S - 1 where the camera moves from pose to pose, and each pixel looks in its own time (`View.exposure`); 0: it
    stands still at each."""
    warp: FrameWarp | None = None
    """Fast motion: the frames to compare with the render from the one given pose."""
    times: Array = field(default_factory=lambda: np.zeros(0))
    """[S] of the poses in frames, where they are along an exposure."""

    @property
    def middle(self) -> tuple[Array, Array]:
        """Rotation and centre in the middle of the exposure."""
        number = len(self.centres) // 2
        return self.rotations[number], self.centres[number]


@dataclass
class RenderPlanner:
    """Plans the render of a view on a path. Times are in frames."""

    camera: Camera
    sub_frames: int | None = None
    """Sub-frames of every view; None follows the motion, 0 renders a still camera."""
    depth: float = 1.0
    """Median depth of the points, in the path's unit, at which image motion is predicted."""
    blur_matched: bool = True
    """See `MapOptions.blur_matched`."""

    def request(self, view: View, path: Path, pixel: int = 1) -> RenderRequest:
        """The render of a view: warped frames for fast motion, sub-frames otherwise.

        `pixel` is the pixel size of the image to be rendered, in sensor pixels.
        """
        return self.warped(view, path) or self.exposed(view, path, pixel)

    def exposed(self, view: View, path: Path, pixel: int = 1) -> RenderRequest:
        """The camera's motion during the exposure of a view, in sub-frames of at most `SUB_FRAME_PX`."""
        parts = self.sub_frames
        if parts == 0:
            rotations, centres = path.poses([view.time])
            return RenderRequest(rotations, centres, times=np.array([view.time]))
        if parts is None:
            times = view.exposure_times(1)
            rotations, centres = path.poses(np.clip(times, path.begin, path.end))
            moved_px = self.motion_px(rotations[0], centres[0], rotations[-1], centres[-1])
            parts = int(np.clip(np.ceil(moved_px / (SUB_FRAME_PX * pixel)), 1, MAX_SUB_FRAMES))
        times = view.exposure_times(parts)
        if not self.blur_matched and not isinstance(view.shown, AdjacentSpikes):  # these have instants
            times, parts = 0.5 * (times[1:] + times[:-1]), 0
        rotations, centres = path.poses(np.clip(times, path.begin, path.end))
        return RenderRequest(rotations, centres, parts, times=times)

    def warped(self, view: View, path: Path) -> RenderRequest | None:
        """For a view of fast motion: one pose, and the frames around it inside the path; None for others, and for
        views of another target."""
        if view.frames is None or view.shown is not None:
            return None
        times = view.first + 0.5 + np.arange(len(view.frames))
        covered = (times >= path.begin) & (times <= path.end)
        rotations, centres = path.poses(np.append(times[covered], view.time))
        first = view.first + int(np.argmax(covered))
        warp = FrameWarp(view.frames[covered], rotations[:-1], centres[:-1], first)
        return RenderRequest(rotations[-1:], centres[-1:], warp=warp)

    def motion_px(self, rotation: Array, centre: Array, other: Array, other_centre: Array) -> float:
        """Image motion in px between two poses, camera to world: `MOTION_PERCENTILE` over nine points at `depth`."""
        k = self.camera.intrinsics
        size = [self.camera.width, self.camera.height]
        at = np.array([[x, y] for x in PROBE_SHARES for y in PROBE_SHARES]) * size
        there = (k.unproject(at) * self.depth @ rotation.T + centre - other_centre) @ other
        return float(np.percentile(np.linalg.norm(k.project(there) - at, axis=1), MOTION_PERCENTILE))
