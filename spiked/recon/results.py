"""`Results`: trajectory, scene, images and report of a reconstruction, as they are now."""

import numpy as np

from spiked.pose import Array
from spiked.recon import report
from spiked.recon.environment import machine, versions
from spiked.recon.mapping.scene_psnr import COMPARED_VIEWS, scene_psnr_db
from spiked.recon.mapping.trainer import MapTrainer
from spiked.recon.options import Options
from spiked.recon.refinement import Refinement
from spiked.recon.report import WorkLog
from spiked.recon.status import Sample, Tracked
from spiked.recon.view_store import ViewRecord
from spiked.recon.view_tracking import ViewTracker
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Image, Intrinsics
from spiked.trajectory import Trajectory


class Results:
    """Reads the parts of a reconstruction and changes none. Methods: see those of `Reconstructor` of the same name."""

    def __init__(
        self, tracker: ViewTracker, trainer: MapTrainer, refinement: Refinement, options: Options, log: WorkLog
    ) -> None:
        self._tracker, self._trainer, self._refinement = tracker, trainer, refinement
        self._options, self._log = options, log

    @property
    def _rate_hz(self) -> float:
        return self._tracker.sensor.frame_rate_hz

    def tracked(self, since: int) -> list[Tracked]:
        """The views tracked so far, without the first `since`."""
        return [_tracked(record, self._rate_hz, self._tracker.unit) for record in self._tracker.views.since(since)]

    def closures(self) -> list[tuple[float, float]]:
        """Closed loops, in seconds."""
        return [(earlier / self._rate_hz, later / self._rate_hz) for earlier, later in self._tracker.odometry.closures]

    def trajectory(self) -> Trajectory:
        """Poses of every frame near a tracked view."""
        return self._poses_at(self.posed_frames())

    def trajectory_so_far(self) -> Trajectory:
        """`trajectory`, or the poses of views alone of a long path that is still tracked."""
        tracker = self._tracker
        if tracker.ended or not tracker.odometry.long or self._refinement.path is None:
            return self.trajectory()
        return self._poses_at(np.array([view.time for view in tracker.views.since(0) if view.posed]))

    def posed_frames(self) -> Array:
        """Middles, in frames, of the frames near a tracked view."""
        if (path := self._refinement.path) is None:
            return np.zeros(0)
        begin, end = max(0, int(np.ceil(path.begin - 0.5))), min(self._tracker.frames, int(path.end + 0.5))
        frames = np.arange(begin, end, dtype=np.float64) + 0.5
        return frames[self._tracker.views.covered(frames)]

    def _poses_at(self, frames: Array) -> Trajectory:
        if (path := self._refinement.path) is None:
            return Trajectory.empty()
        rotations, centres = path.poses(frames)
        return Trajectory(frames / self._rate_hz, rotations, centres * self._tracker.unit)

    def scene(self) -> Scene:
        """A copy of the map."""
        scene, unit = self._trainer.mapper.scene, self._tracker.unit
        scene = scene.select(np.arange(len(scene)))
        scene.means *= np.float32(unit)
        scene.log_scales += np.float32(np.log(unit))
        return scene

    def view(self, rotation: Array, centre: Array) -> Image:
        """The map from a pose."""
        return self._trainer.mapper.render(rotation, centre / self._tracker.unit)

    def scene_psnr_db(self, scene: Scene, trajectory: Trajectory, intrinsics: Intrinsics) -> float:
        """PSNR of a scene along a trajectory against the recording."""
        sensor, stored = self._trainer.sensor, self._tracker.views
        rasteriser = rasteriser_for(Camera(intrinsics, sensor.width, sensor.height), self._options.threads)
        views = [stored.image(i, sharp=True) for i in stored.spread(stored.kept, COMPARED_VIEWS)]
        return scene_psnr_db(views, sensor, rasteriser, scene, trajectory)

    def level(self, time_s: float) -> float:
        """Brightness of the image at a time relative to the map's."""
        nearest = self._tracker.views.nearest(time_s * self._rate_hz)
        return 1.0 if nearest is None else self._trainer.mapper.nuisances.level(nearest)

    def samples(self, count: int) -> list[Sample]:
        """Observed and rendered images."""
        path = self._refinement.path
        return report.samples(self._tracker.views, self._trainer.mapper, path, self._rate_hz, count)

    def report(self, failure: str | None) -> dict[str, object]:
        """Versions, machine, parameters, states with reasons, timings and gaps; `failure`: why there is no path."""
        sensor, mapper, odometry = self._trainer.sensor, self._trainer.mapper, self._tracker.odometry
        return {
            "versions": versions(),
            "machine": machine(),
            "sensor": {"width": sensor.width, "height": sensor.height, "frame_rate_hz": sensor.frame_rate_hz},
            **report.optics_section(mapper, odometry.focal, odometry.lens),
            "options": report.options_section(self._options),
            "frames": self._tracker.frames,
            "gaps": [{"first_frame": f, "frames": n} for f, n in self._tracker.gaps],
            "outcome": "complete" if failure is None else "failed",
            "warnings": list(self._tracker.warnings),
            **report.tracking_section(odometry, self._tracker.views.since(0), sensor.frame_rate_hz),
            **report.path_section(self._refinement.path, odometry, self._refinement.aligned),
            "closures": report.closures_section(self.closures()),
            **report.map_section(mapper),
            **self._log.report(),
        }


def _tracked(record: ViewRecord, frame_rate_hz: float, unit: float) -> Tracked:
    """What is told of a view; `unit` is the trajectory's length unit over the map's."""
    view = record.tracked
    centre = None if view.centre is None else view.centre * unit
    time_s = view.time / frame_rate_hz
    return Tracked(view.time, time_s, view.state, view.rotation, centre, record.rate, view.sigma_px, view.chi2)
