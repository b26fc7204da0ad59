"""Two maps of one place become one, without their recordings: the joint map is trained on renders of both."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spiked.recon.mapping.mapper import Mapper
from spiked.recon.mapping.options import MapOptions
from spiked.recon.mapping.replay import Replay
from spiked.recon.merging.coverage import Shown
from spiked.recon.merging.joining import Joint, join
from spiked.recon.merging.known_map import KnownMap
from spiked.recon.statistics import median
from spiked.scene import Scene
from spiked.sensor import Sensor

STEPS_A_PLACE = 5
"""Steps of the training for each place of both ways."""
LEAST_KNOWN = 0.02
"""Share of an image that a view needs to be trained on."""
FIRST_RATE = 0.15
"""Factor on the learning rates at the start of the training, as near the end of a refinement; it falls to zero."""
DENSIFY_EVERY = 10
"""Steps between densifications."""
DENSIFY_UNTIL = 0.6
"""Share of the steps with densification."""
HEADROOM = 1.1
"""Most splats of a joint map over those that were joined."""


@dataclass(frozen=True)
class Merged:
    """One map of two, in the frame of reference and the radiance of the first."""

    scene: Scene
    joint: Joint
    """The two maps before they became one."""
    kept: tuple[int, int]
    """Splats that each of them gave."""
    psnr_db: tuple[float, float]
    """How well the scene shows what each map showed along its way: mean over the views."""

    def report(self) -> dict[str, object]:
        """How the two were brought together, ready for JSON."""
        joint, found = self.joint, self.joint.registration
        scales = [one.scale for one in found.warp.similarities]
        return {
            "similarity": {
                "scale": found.similarity.scale,
                "rotation": found.similarity.rotation.tolist(),
                "translation": found.similarity.translation.tolist(),
            },
            "scale_range": [min(scales), max(scales)],
            "scale_sigma": found.scale_sigma,
            "turn_sigma_deg": found.turn_sigma_deg,
            "shift_sigma": found.shift_sigma,
            "residual_px": found.residual_px,
            "searched": found.searched,
            "recognised": found.recognised,
            "agreeing": len(found.sightings),
            "views_alike": joint.alike,
            "views_different": joint.different,
            "brightness": joint.brightness,
            "splats_kept": list(self.kept),
            "psnr_db": list(self.psnr_db),
        }


def merge(
    first: KnownMap,
    second: KnownMap,
    *,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Merged:
    """Make one map of two: the splats of each that show a surface more finely, trained to show what both showed.

    `progress` gets the share of the training that is done; when `cancelled` returns true, the training ends early.
    Raises NotOnePlaceError, and SceneError for a map that is empty or has no texture.
    """
    joint = join(first, second, threads)
    kept = joint.kept()
    scene = _trained(joint, kept, seed, threads, progress, cancelled)
    return merged(scene, joint, kept)


def merged(scene: Scene, joint: Joint, kept: tuple[NDArray[np.bool_], NDArray[np.bool_]]) -> Merged:
    """A trained scene with the figures of how it came about."""
    white = scene.colour_of_white
    psnr_db = _psnr_db(scene, joint.first_views, white), _psnr_db(scene, joint.second_views, white)
    return Merged(scene, joint, (int(kept[0].sum()), int(kept[1].sum())), psnr_db)


def _psnr_db(scene: Scene, views: Sequence[Shown], white: float) -> float:
    errors = [view.replay.error(scene, white) for view in views]
    return float(np.mean(-10 * np.log10(np.maximum(errors, 1e-12))))


def _trained(
    joint: Joint,
    kept: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    seed: int,
    threads: int | None,
    progress: Callable[[float], None],
    cancelled: Callable[[], bool],
) -> Scene:
    scene, camera = joint.splats(kept), joint.first.camera
    mapper = Mapper(
        Sensor(camera.width, camera.height, 1.0, intrinsics=camera.intrinsics),
        camera,
        replace(MapOptions(), splats_a_pixel=HEADROOM * len(scene) / (camera.width * camera.height), most_splats=2**31),
        seed,
        threads,
    )
    mapper.adopt(scene)
    mapper.white = scene.colour_of_white
    views = [*joint.first_views, *joint.second_views]
    mapper.depth = median(np.concatenate([one.depth[one.opaque][::97] for one in views]).astype(np.float64))
    replays = [one for one in joint.replays(kept) if one.known.mean() > LEAST_KNOWN]
    for share in rehearse(mapper, replays, STEPS_A_PLACE * len(replays), np.random.default_rng(seed)):
        progress(share)
        if cancelled():
            break
    return mapper.scene


def rehearse(mapper: Mapper, replays: Sequence[Replay], steps: int, rng: np.random.Generator) -> Iterator[float]:
    """Train a map on renders of others in random order; yields the share of the steps that is done."""
    queue: list[int] = []
    for done in range(steps):
        queue = queue or rng.permutation(len(replays)).tolist()
        replay, share = replays[queue.pop()], done / steps
        mapper.replay(replay, FIRST_RATE * (1 - share))
        if share < DENSIFY_UNTIL and done % DENSIFY_EVERY == DENSIFY_EVERY - 1:
            mapper.densify_replay(replay)
        yield (done + 1) / steps
