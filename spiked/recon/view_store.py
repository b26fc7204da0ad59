"""The views of a recording: one record each, by id."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.recorded_views import RecordedViews, ViewFrames
from spiked.recon.frontend.windowing import View
from spiked.recon.odometry.sparse_map import TrackedView
from spiked.recon.odometry.tracking_state import State
from spiked.recon.statistics import evenly
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
    frames: ViewFrames
    """What its image is made of."""
    bridged: bool = False
    """Frames before this view were skipped, so few that the path is interpolated over them."""

    @property
    def id(self) -> int:
        """Number in order of tracking; it never changes."""
        return self.tracked.id

    @property
    def time(self) -> float:
        """The middle of the view in frames."""
        return self.tracked.time

    @property
    def posed(self) -> bool:
        """Whether the view has a pose that can be relied on."""
        return self.tracked.rotation is not None and self.tracked.state is not State.LOST


class ViewStore:
    """The records of all views, and the images of the views that the map is fitted to, which are `kept`.

    What is held in memory is bounded here, whatever the length of the recording: images beyond the limit are built anew
    when they are asked for. Where they cannot be, fewer views are kept.
    """

    def __init__(self, most_views: int, most_bytes: float = np.inf, recorded: RecordedViews | None = None) -> None:
        """`most_views` are kept, and images of at most `most_bytes` held; the newest `PROTECTED_VIEWS` are always.

        `recorded` builds the others.
        """
        self._most_views = most_views
        self._most_bytes = most_bytes
        self._recorded = recorded
        self._records: list[ViewRecord] = []
        self._travelled_px: list[float] = []
        self._kept: list[int] = []
        self._held: dict[int, View] = {}
        """Images in memory, those used last at the end."""
        self._held_bytes = 0

    def __getstate__(self) -> dict[str, object]:
        """For a checkpoint: without images, which are built anew."""
        return vars(self) | {"_held": {}, "_held_bytes": 0}

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

    def travelled_to(self, ids: Sequence[int]) -> Array:
        """Image motion of the path up to each of these views, in px."""
        return np.array([self._travelled_px[view_id] for view_id in ids])

    @property
    def kept(self) -> list[int]:
        """Ids of the views that the map may use, in order of time."""
        return self._kept

    def add(self, image: View, tracked: TrackedView, bridged: bool = False) -> ViewRecord:
        """Add the next view: `tracked.id` is the number of records before it."""
        assert tracked.id == len(self._records)
        rate = image.spikes_a_pixel / (image.end - image.begin)
        record = ViewRecord(tracked, rate, ViewFrames.of(image), bridged)
        self._records.append(record)
        self._travelled_px.append(self.travelled_px + tracked.moved_px)
        self._kept.append(record.id)
        self._hold(record.id, image)
        return record

    def thin(self) -> bool:
        """If there are too many views, drop a share of them; returns whether it did.

        Dropped first is the view between whose neighbours the camera moved least: the others stay spread over the
        path, and a camera that stands still adds none.
        """
        if len(self._kept) <= self._most_views and self._held_bytes <= self._most_bytes:
            return False
        newest = min(PROTECTED_VIEWS, len(self._kept) // 4)
        for _ in range(int(DROPPED_SHARE * min(self._most_views, len(self._kept)))):
            at = np.array([self._travelled_px[view_id] for view_id in self._kept])
            least = 1 + int(np.argmin((at[2:] - at[:-2])[:-newest]))
            self._drop(self._kept.pop(least))
        return True

    def candidates(self, path: Path) -> list[TrackedView]:
        """All views with a pose inside the path whose image is held or can be built anew."""
        posed = (record for record in self._records if record.posed and path.begin <= record.time <= path.end)
        return [record.tracked for record in posed if record.id in self._held or self.rebuildable(record.id)]

    def keep(self, ids: Sequence[int]) -> None:
        """Keep these views, some of `candidates`, and no others."""
        self._kept = list(ids)
        for view_id in set(self._held) - set(ids):
            self._drop(view_id)

    def image(self, view_id: int, sharp: bool = False) -> View:
        """The image of a kept view; `sharp`: with its motion-compensated image, if it has one.

        Each call returns a new object: rates cached in it go with it.
        """
        image, frames = self._held.get(view_id), self[view_id].frames
        lacking = image is None or (sharp and image.sharp is None and frames.warped is not None)
        if lacking and self._recorded is not None and (built := self._recorded.build(frames, sharp)) is not None:
            image = built
        assert image is not None, f"the image of view {view_id} was dropped"
        self._drop(view_id)
        self._hold(view_id, image)
        return replace(image)

    def rebuildable(self, view_id: int) -> bool:
        """Whether the frames of a view can be read again."""
        return self._recorded is not None and self._recorded.holds(self[view_id].frames)

    def rebuilt(self, view_id: int) -> View | None:
        """Any view, built anew with its motion-compensated image and not held; None if it cannot be."""
        return None if self._recorded is None else self._recorded.build(self[view_id].frames, sharp=True)

    def images(self, ids: Sequence[int]) -> Iterator[tuple[int, View]]:
        """Ids and images of views, one after the other."""
        return ((view_id, self.image(view_id)) for view_id in ids)

    @property
    def held_bytes(self) -> int:
        """Bytes of the images in memory."""
        return self._held_bytes

    def _hold(self, view_id: int, image: View) -> None:
        """Hold an image; those used least recently that can be built anew make room for it."""
        self._held[view_id] = replace(image)
        self._held_bytes += image.nbytes
        if self._recorded is None or self._held_bytes <= self._most_bytes:
            return
        newest = len(self._records) - PROTECTED_VIEWS
        for other in list(self._held):
            if self._held_bytes <= self._most_bytes:
                return
            if other < newest and other != view_id and self._recorded.holds(self[other].frames):
                self._drop(other)

    def _drop(self, view_id: int) -> None:
        image = self._held.pop(view_id, None)
        self._held_bytes -= 0 if image is None else image.nbytes

    def mappable(self, path: Path | None) -> list[int]:
        """Ids of the kept views with a pose, inside the path and not lost."""
        if path is None:
            return []
        return [i for i in self._kept if path.begin <= self[i].time <= path.end and self[i].posed]

    @staticmethod
    def spread(ids: Sequence[int], count: int) -> list[int]:
        """At most `count` of these ids, evenly spread."""
        return [ids[i] for i in evenly(len(ids), count)]

    def at(self, time: float) -> ViewRecord:
        """The record of the view at, or the last one before, a time in frames."""
        return self._records[max(bisect_right(self._records, time, key=lambda record: record.time) - 1, 0)]

    def nearest(self, time: float) -> int | None:
        """Id of the kept view nearest to a time in frames; None without views."""
        if not self._kept:
            return None
        times = np.array([self[i].time for i in self._kept])
        return self._kept[int(np.argmin(np.abs(times - time)))]

    def covered(self, frames: Array) -> NDArray[np.bool_]:
        """At which of these times in frames [N], ascending, the path is known: near a view with a pose and in no view
        without, or between bridged views."""
        posed = [record for record in self._records if record.tracked.rotation is not None]
        ids = np.array([record.id for record in posed])
        times = np.array([record.time for record in posed])
        reach = np.array([record.tracked.length for record in posed])
        after = np.clip(np.searchsorted(times, frames), 1, len(times) - 1)
        near = np.where(np.abs(times[after - 1] - frames) < np.abs(times[after] - frames), after - 1, after)
        covered = np.abs(times[near] - frames) <= POSE_REACH_LENGTHS * reach[near]
        for record in self._records:
            if record.tracked.rotation is None:
                ends = record.time + 0.5 * record.tracked.length * np.array([-1, 1])
                begin, end = np.searchsorted(frames, ends[0]), np.searchsorted(frames, ends[1], side="right")
                covered[begin:end] = False
        bridged = np.array([record.bridged for record in posed]) & (np.diff(ids, prepend=-2) == 1)
        covered |= bridged[after] & (frames > times[after - 1]) & (frames < times[after])
        return np.asarray(covered)
