"""An odometry without tracks: it keeps the views, and the path is estimated by the map alone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import Picture
from spiked.recon.frontend.photon_counts import PhotonCounts
from spiked.recon.frontend.spike_intervals import SpikeIntervals
from spiked.recon.odometry.odometry import Odometry
from spiked.recon.odometry.sparse_map import Pose, TrackedView
from spiked.recon.odometry.tracking_state import State
from spiked.spline import Path, Spline

LEAST_KNOT_FRAMES = 8.0
"""Least spacing of the knots."""
_NO_IDS: NDArray[np.int64] = np.zeros(0, np.int64)
_REASON = "the poses are estimated by the map alone, without tracks"


@dataclass(eq=False)
class UntrackedView(TrackedView):
    """A view without tracks."""

    @property
    def moved_px(self) -> float:
        """The same for each view, as its motion is not known: views are dropped evenly."""
        return 1.0


class UntrackedOdometry(Odometry):
    """Views without tracks. At `end` the path stands still, and a schedule that estimates it goes on from there."""

    def add(
        self,
        time: float,
        length: int,
        picture: Picture,
        known: tuple[Array, Array] | None = None,
        intervals: SpikeIntervals | PhotonCounts | None = None,
        after_gap: bool = False,
    ) -> TrackedView:
        """Add a view of `length` frames around `time`, without a pose."""
        del picture, known, intervals, after_gap
        view = UntrackedView(len(self.views), time, length, _NO_IDS, np.zeros((0, 2)), 0.0, self.state)
        self.views.append(view)
        if self.state is State.BOOT:
            self._status.explain("without tracks, poses are estimated after the last frame")
        return view

    def end(self, *_: object) -> None:
        """Stand still at the origin: a linear spline with a knot for each view."""
        times = np.array([view.time for view in self.views])
        if len(times) < 2:
            self._status.explain("too few views for a path")
            return
        still, spacing = np.repeat(np.eye(3)[None], len(times), 0), float(np.median(np.diff(times)))
        spacing = max(spacing, LEAST_KNOT_FRAMES)
        # Knots between the views would be free to move to both sides in turn.
        span = times[0] - spacing, times[-1] + spacing
        path = Spline.fit(times, still, np.zeros((len(times), 3)), spacing, 1, span)
        self._adjuster.spline = path
        self._status.set(self.views[-1].time, State.TRACK, _REASON)
        self.follow(path)

    def follow(self, path: Path) -> None:
        """Give the views their poses on a path."""
        rotations, centres = path.poses([view.time for view in self.views])
        for view, rotation, centre in zip(self.views, rotations, centres, strict=True):
            view.pose, view.state = Pose(rotation, centre), State.TRACK
