"""A known map is extended by a recording: reconstructed alone, brought into the map's frame, and trained together."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from spiked.pose import Array
from spiked.recon.mapping.trainer import MapTrainer
from spiked.recon.merging.joining import Joint, join
from spiked.recon.merging.known_map import KnownMap, brightened
from spiked.recon.merging.merger import FIRST_RATE, HEADROOM, Merged, merge, merged
from spiked.recon.merging.path_warp import PathWarp
from spiked.recon.reconstructor import Reconstructor
from spiked.spline import Path

STEPS_A_VIEW = 10
"""Steps on the recording for each place of its way; as many steps again replay the map."""


@dataclass(frozen=True)
class WarpedPath:
    """The path of a reconstruction in the frame of reference of a map."""

    path: Path
    warp: PathWarp
    unit: float
    """Length of the path's unit in that of the reconstruction's trajectory."""
    frame_rate_hz: float

    @property
    def begin(self) -> float:
        """First time in frames."""
        return self.path.begin

    @property
    def end(self) -> float:
        """Last time in frames."""
        return self.path.end

    def poses(self, times: ArrayLike) -> tuple[Array, Array]:
        """Camera-to-world rotations [n, 3, 3] and centres [n, 3] at times [n] in frames."""
        rotations, centres = self.path.poses(times)
        return self.warp.poses(np.asarray(times, np.float64) / self.frame_rate_hz, rotations, centres * self.unit)


def extend(
    known: KnownMap,
    reconstructor: Reconstructor,
    progress: Callable[[float], None] = lambda share: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Merged:
    """One map of a known one and of a finished reconstruction, in the known map's frame of reference and radiance.

    The splats are trained on the recording's views, or on renders of them where the recording is grey and the map is
    in colour, and on renders of the known map, which keep what it shows. The recording that it was made from is not
    needed. `reconstructor` is not changed. `progress` gets the share of the training that is done; when `cancelled`
    returns true, the training ends early.
    Raises NotOnePlaceError, and SceneError for a map that is empty or has no texture.
    """
    options = reconstructor.options
    alone = replace(reconstructor.scene(), white=reconstructor.white)
    second = KnownMap(alone, reconstructor.trajectory(), reconstructor.camera)
    if known.scene.colours.shape[1] > alone.colours.shape[1]:
        return merge(known, second, seed=options.seed, threads=options.threads, progress=progress, cancelled=cancelled)
    joint = join(known, second, options.threads)
    kept = joint.kept()
    trainer, path = _trainer(joint, reconstructor)
    trainer.fit_motion(path)
    trainer.mapper.adopt(brightened(joint.splats(kept), 1 / joint.brightness))
    trainer.mapper.extent = HEADROOM * len(trainer.mapper) / (trainer.mapper.cap / trainer.mapper.extent)
    replays = [one.replay.brightened(1 / joint.brightness) for one in joint.first_views]
    rng, queue = np.random.default_rng(options.seed), list[int]()
    steps = min(STEPS_A_VIEW * len(joint.second_views), options.steps)
    for done in range(steps):
        share = done / steps
        trainer.step(path, FIRST_RATE * (1 - share), 0.0, share)
        queue = queue or rng.permutation(len(replays)).tolist()
        trainer.mapper.replay(replays[queue.pop()], FIRST_RATE * (1 - share))
        progress((done + 1) / steps)
        if cancelled():
            break
    return merged(brightened(trainer.mapper.scene, joint.brightness), joint, kept)


def _trainer(joint: Joint, reconstructor: Reconstructor) -> tuple[MapTrainer, WarpedPath]:
    """A trainer on the recording's views, and their path, in the known map's frame of reference."""
    options, before = reconstructor.options, reconstructor.trainer
    assert reconstructor.path is not None
    scale = reconstructor.unit * joint.registration.similarity.scale
    trainer = MapTrainer(
        reconstructor.sensor,
        reconstructor.views,
        options.fitted,
        options.seed,
        options.threads,
        options.calibration,
    )
    trainer.planner.depth = before.planner.depth * scale
    trainer.mapper.depth = before.mapper.depth * scale
    trainer.mapper.white, trainer.mapper.nuisances = before.mapper.white, before.mapper.nuisances
    warp = joint.registration.warp
    return trainer, WarpedPath(reconstructor.path, warp, reconstructor.unit, reconstructor.sensor.frame_rate_hz)
