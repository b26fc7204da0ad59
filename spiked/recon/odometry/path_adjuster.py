"""What adjusts the path of a map while it grows."""

from collections.abc import Callable
from typing import Protocol

from spiked.pose import Array
from spiked.recon.odometry.sparse_map import TrackedView
from spiked.spline import Spline


class PathAdjuster(Protocol):
    """Adjusts poses and points of a map: `GlobalAdjuster` for short paths, `KeyframeAdjuster` for long ones."""

    interpolated: bool
    """There is no spline: the path is interpolated between views, see `SparseMap.waypoints`."""

    spline: Spline | None
    """The path in frames; None before the first adjustment, and where it is interpolated."""
    closures: list[tuple[float, float]]
    """Closed loops: times in frames of an earlier view and of a later one that sees the same place again."""

    @property
    def end_left(self) -> float:
        """Share of the work of `finish` that is left, by its rounds."""

    @property
    def reference_views(self) -> list[TrackedView]:
        """Earlier views, oldest first, from which tracks are triangulated and to which the newest views are adjusted.

        Empty: those just before the newest.
        """

    @property
    def newest_keyframe(self) -> TrackedView | None:
        """The newest keyframe; None on short paths."""

    @property
    def due(self) -> bool:
        """Whether the map has grown enough since the last adjustment."""

    def adjust(self, final: bool = True) -> None:
        """Adjust what is due; without `final`, with less effort where that suffices."""

    def finish(
        self,
        stop: Callable[[], bool] = lambda: False,
        save: Callable[[], None] = lambda: None,
        preliminary: bool = False,
    ) -> None:
        """The last adjustment, of the whole path. On a long path it ends soon after `stop` becomes true: loops may then
        be open. `save` is called wherever a copy of the adjuster goes on with the same result; `preliminary`: with
        fewer keyframes where the path is long."""

    def path_error(self) -> float | None:
        """Predicted error of the path relative to its RMS radius; None if it is not predicted, as of long paths."""
        return None

    def information(self) -> Array | None:
        """Inverse covariance [6 knots, 6 knots] of `spline`; None without one."""
        return None
