"""The views of a recording: one record each, by id."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.windowing import View
from spiked.recon.odometry.sparse_map import TrackedView
from spiked.recon.odometry.tracking_state import State
from spiked.spline import Path

PROTECTED_VIEWS = 16
"""Newest views whose images are not dropped: a live map is seeded from them."""
DROPPED_SHARE = 0.25
"""Share of the images that is dropped at a time."""
POSE_REACH_LENGTHS = 1.5
"""Lengths of a view over which its pose is valid, before and after its middle."""


@dataclass
class ViewRecord:
    """One view."""

    tracked: TrackedView
    """Time, pose, state and tracks, as the odometry has them."""
    rate: float
    """Mean spikes a pixel and frame."""
    bridged: bool = False
    """Frames before this view were skipped, so few that the path is interpolated over them."""
    image: View | None = None
    """Rates and frames; None where the map does without this view. Read it with `ViewStore.image`."""

    @property
    def id(self) -> int:
        """Number in order of tracking; it never changes."""
        return self.tracked.id

    @property
    def time(self) -> float:
        """The middle of the view in frames."""
        return self.tracked.time

    @property
    def mappable(self) -> bool:
        """Whether the view has an image and a pose that can be relied on."""
        return self.image is not None and self.tracked.rotation is not None and self.tracked.state is not State.LOST


class ViewStore:
    """The records of all views, and the images of the views that the map is fitted to.

    What is held in memory is bounded here: images of at most `most_images` views. The rest of the reconstruction knows
    a view by its id, and reads an image only by `image`.
    """

    def __init__(self, most_images: int) -> None:
        self._most_images = most_images
        self._records: list[ViewRecord] = []
        self._travelled_px: list[float] = []
        self._kept: list[int] = []

    def __len__(self) -> int:
        return len(self._records)

    def __getitem__(self, view_id: int) -> ViewRecord:
        """The record of a view; negative numbers count from the newest."""
        return self._records[view_id]

    def since(self, view_id: int) -> list[ViewRecord]:
        """The records of this view and of all later ones."""
        return self._records[view_id:]

    @property
    def travelled_px(self) -> float:
        """Image motion of the whole path."""
        return self._travelled_px[-1] if self._travelled_px else 0.0

    @property
    def kept(self) -> list[int]:
        """Ids of the views with an image, in order of time."""
        return self._kept

    def add(self, image: View, tracked: TrackedView, bridged: bool = False) -> ViewRecord:
        """Add the next view: `tracked.id` is the number of records before it."""
        assert tracked.id == len(self._records)
        rate = image.spikes_a_pixel / (image.end - image.begin)
        record = ViewRecord(tracked, rate, bridged, image)
        self._records.append(record)
        self._travelled_px.append(self.travelled_px + tracked.moved_px)
        self._kept.append(record.id)
        return record

    def thin(self) -> bool:
        """If there are too many images, drop a share of them; returns whether it did.

        Dropped first is the image between whose neighbours the camera moved least: the others stay spread over the
        path, and a camera that stands still adds none.
        """
        if len(self._kept) <= self._most_images:
            return False
        newest = min(PROTECTED_VIEWS, self._most_images // 4)
        for _ in range(int(DROPPED_SHARE * self._most_images)):
            at = np.array([self._travelled_px[view_id] for view_id in self._kept])
            least = 1 + int(np.argmin((at[2:] - at[:-2])[:-newest]))
            self._records[self._kept.pop(least)].image = None
        return True

    def image(self, view_id: int) -> View:
        """The image of a kept view."""
        image = self._records[view_id].image
        assert image is not None, f"the image of view {view_id} was dropped"
        return image

    def images(self) -> list[View]:
        """The images of the kept views, in order of time."""
        return [self.image(view_id) for view_id in self._kept]

    def mappable(self, path: Path | None) -> list[int]:
        """Ids of the kept views with a pose, inside the path and not lost."""
        if path is None:
            return []
        return [i for i in self._kept if path.begin <= self[i].time <= path.end and self[i].mappable]

    def nearest(self, time: float) -> int | None:
        """Id of the kept view nearest to a time in frames; None without views."""
        if not self._kept:
            return None
        times = np.array([self[i].time for i in self._kept])
        return self._kept[int(np.argmin(np.abs(times - time)))]

    def covered(self, frames: Array) -> NDArray[np.bool_]:
        """At which times in frames [N] the path is known: near a view with a pose and in no view without, or between
        bridged views."""
        posed = [record for record in self._records if record.tracked.rotation is not None]
        ids = np.array([record.id for record in posed])
        times = np.array([record.time for record in posed])
        reach = np.array([record.tracked.length for record in posed])
        after = np.clip(np.searchsorted(times, frames), 1, len(times) - 1)
        near = np.where(np.abs(times[after - 1] - frames) < np.abs(times[after] - frames), after - 1, after)
        covered = np.abs(times[near] - frames) <= POSE_REACH_LENGTHS * reach[near]
        for record in self._records:
            if record.tracked.rotation is None:
                covered &= np.abs(frames - record.time) > 0.5 * record.tracked.length
        bridged = np.array([record.bridged for record in posed]) & (np.diff(ids, prepend=-2) == 1)
        covered |= bridged[after] & (frames > times[after - 1]) & (frames < times[after])
        return np.asarray(covered)
