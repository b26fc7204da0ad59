"""What a reconstruction reports at its end: its samples, its work, and the sections of `report.json`."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from spiked.pose import log_so3
from spiked.recon.frontend.demosaic import fill_mosaic
from spiked.recon.mapping.mapper import Mapper
from spiked.recon.odometry.assessment import WORST_PATH_ERROR
from spiked.recon.odometry.odometry import Odometry
from spiked.recon.odometry.self_calibration import EstimatedLens, Focal, corner_px
from spiked.recon.odometry.sparse_map import TrackedView
from spiked.recon.options import Options
from spiked.recon.status import Sample
from spiked.recon.view_store import ViewRecord, ViewStore
from spiked.spline import Path, Spline


def samples(views: ViewStore, mapper: Mapper, path: Path | None, frame_rate_hz: float, count: int) -> list[Sample]:
    """At most `count` views, evenly spread over the recording, beside their renders from `path`."""
    path = path if len(mapper) else None
    ids = views.kept if path is None else views.mappable(path)
    out = []
    for view_id in views.spread(ids, count):
        view, rendered = views.image(view_id), None
        if path is not None:
            rotations, centres = path.poses([view.time])
            rendered = mapper.render(rotations[0], centres[0])
        out.append(Sample(view.time / frame_rate_hz, fill_mosaic(view.rate, mapper.channels), rendered))
    return out


@dataclass
class WorkLog:
    """Seconds of work in each stage, and the quality of the map over them."""

    seconds: dict[str, float] = field(default_factory=lambda: {"tracking": 0.0, "mapping": 0.0, "refining": 0.0})
    losses: list[tuple[float, float]] = field(default_factory=list)
    """(seconds of work, mean squared error of the views in units of white squared)."""
    _stage: str = ""
    _begin: float | None = None
    """Since when the stage is measured; None while none is."""

    def __getstate__(self) -> dict[str, object]:
        """For a checkpoint: with the work of the stage that is being measured."""
        return vars(self) | {"seconds": self._seconds(), "_begin": None}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Count the time within as work of a stage."""
        self._stage, self._begin = stage, time.perf_counter()
        try:
            yield
        finally:
            self.seconds, self._begin = self._seconds(), None

    def _seconds(self) -> dict[str, float]:
        """With the stage that is being measured."""
        if self._begin is None:
            return self.seconds
        running_s = time.perf_counter() - self._begin
        return self.seconds | {self._stage: self.seconds[self._stage] + running_s}

    @property
    def total_s(self) -> float:
        """Seconds of work so far."""
        return sum(self._seconds().values())

    def note(self, loss: float | None) -> None:
        """Append a loss, if there is one."""
        if loss is not None:
            self.losses.append((self.total_s, loss))

    def report(self) -> dict[str, object]:
        """The section of the report."""
        seconds = self.seconds | {"total": self.total_s}
        return {
            "psnr_of_views_over_seconds": [
                [round(s, 2), round(float(-10 * np.log10(loss)), 2)] for s, loss in self.losses
            ],
            "seconds": {stage: round(s, 3) for stage, s in seconds.items()},
        }


def path_warning(path_error: float | None) -> str | None:
    """A warning where the predicted error of the path is large."""
    if path_error is None or path_error <= WORST_PATH_ERROR:
        return None
    return (
        f"the shape of the whole path is only known to about {path_error:.0%}, before the map corrects it: "
        "few tracks tie its parts together; more sideways motion, slower motion or more light would help"
    )


def options_section(options: Options) -> dict[str, object]:
    """All options; of poses, calibration and depth only whether they were given."""
    names = "poses", "calibration", "first_depth"
    given = {name: getattr(options, name) is not None for name in names}
    return asdict(replace(options, poses=None, calibration=None, first_depth=None)) | given


def tracking_section(odometry: Odometry, records: list[ViewRecord], frame_rate_hz: float) -> dict[str, object]:
    """State, its changes, and every view, of which `records` have the spike rates."""
    rates = {record.id: record.rate for record in records}
    return {
        "path_error_predicted": odometry.path_error,
        "state": str(odometry.state),
        "reason": odometry.reason,
        "states": [{"time_s": t / frame_rate_hz, "state": str(s), "reason": r} for t, s, r in odometry.changes],
        "views": [_view(view, frame_rate_hz, rates.get(view.id)) for view in odometry.views],
    }


def _view(view: TrackedView, frame_rate_hz: float, rate: float | None) -> dict[str, object]:
    return {
        "time_s": view.time / frame_rate_hz,
        "frames": view.length,
        "rate": None if rate is None else round(rate, 5),
        "motion_px": round(view.motion_px, 3),
        "inliers": round(view.inliers, 3),
        "chi2": None if view.chi2 is None else round(view.chi2, 3),
        "sigma_px": None if view.sigma_px is None else round(view.sigma_px, 4),
        "state": str(view.state),
    }


def closures_section(closures: list[tuple[float, float]]) -> list[dict[str, float]]:
    """Closed loops in order of the later view."""
    ordered = sorted(closures, key=lambda closure: closure[1])
    return [{"earlier_s": round(earlier, 6), "later_s": round(later, 6)} for earlier, later in ordered]


def optics_section(mapper: Mapper, focal: Focal | None, estimated: EstimatedLens | None) -> dict[str, object]:
    """The intrinsics in use; `focal` and `estimated` where focal length and distortion were estimated."""
    sigma = None if focal is None or not np.isfinite(focal.relative_sigma) else focal.relative_sigma
    lens = mapper.camera.intrinsics.distortion
    return {
        "focal_px": [mapper.camera.intrinsics.fx, mapper.camera.intrinsics.fy],
        "principal_point_px": [mapper.camera.intrinsics.cx, mapper.camera.intrinsics.cy],
        **({} if lens is None else {"distortion": {"model": str(lens.model), **lens.named()}}),
        "focal_estimated": focal is not None,
        "focal_relative_sigma": sigma,
        "distortion_estimated": estimated is not None,
        "distortion_corner_px": None if lens is None else corner_px(mapper.camera.intrinsics),
        "distortion_corner_sigma_px": None if estimated is None else estimated.corner_sigma_px,
    }


def map_section(mapper: Mapper) -> dict[str, object]:
    """Size and fit of the map."""
    return {"splats": len(mapper), "steps": mapper.steps, "loss": mapper.loss}


def path_section(path: Path | None, odometry: Odometry, aligned: bool) -> dict[str, object]:
    """Knots of the final path, and where it was aligned with the map its RMS rotation from the tracked one."""
    correction_deg, tracked = None, odometry.spline
    if aligned and path is not None and tracked is not None:
        times = np.array([view.time for view in odometry.views if view.rotation is not None])
        turned = path.poses(times)[0] @ tracked.poses(times)[0].swapaxes(1, 2)
        correction_deg = float(np.degrees(np.sqrt((log_so3(turned) ** 2).sum(1).mean())))
    spacing = path.spacing if isinstance(path, Spline) else None
    return {"knot_spacing_frames": spacing, "correction_deg": correction_deg}
