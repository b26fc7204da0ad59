"""Days on which the scene does not hold still, or cannot be seen for a while."""

from collections.abc import Callable

import numpy as np
import pytest
from staging import SENSOR, ObstructedCamera, behind, followed, patch, wall

from spiked.recon import State
from spiked.simulate import MotionKind

FRAMES = 400
Figure = Callable[[str, object, str], None]
MOVING = 1.5
"""Error of the path, in those of the scene without the object."""


def camera(kind: MotionKind = MotionKind.ARC, seed: int = 2) -> ObstructedCamera:
    return ObstructedCamera(SENSOR, seed, kind, flow_px=0.3, parallax=0.5)


@pytest.fixture(scope="module")
def static() -> float:
    """The path's error in percent when nothing moves."""
    return followed(camera(), FRAMES)[1]


@pytest.mark.validation
@pytest.mark.parametrize("begin", [0, 200], ids=["in_the_first_views", "later"])
def test_an_object_crossing_15_percent_of_the_image(static: float, begin: int, figure: Figure) -> None:
    """Evenly moving tracks look near, and near ones say most about the path: it was bent by 10 to 15 %, and called
    degraded at best."""
    seen = behind(camera(), patch(0.15, (-20 - 0.8 * begin, 42), (0.8, 0.0)), 0.8)
    reconstructor, error, coverage = followed(seen, FRAMES)
    place = "later" if begin else "in the first views"
    figure(f"15 % of the area moving {place}: ATE over static", f"{error / static:.2f}", "< 1.5")
    assert reconstructor.status().state is State.TRACK, reconstructor.status().reason
    assert error < MOVING * static and coverage > 0.98


@pytest.mark.slow
@pytest.mark.validation
def test_objects_crossing_on_many_ways(figure: Figure) -> None:
    ways = [
        (MotionKind.ARC, 2, (-20, 42), (0.8, 0.0)),
        (MotionKind.ARC, 1, (80, -20), (0.0, 0.5)),
        (MotionKind.ARC, 3, (150, 10), (-0.6, 0.3)),
        (MotionKind.HAND_SHAKE, 1, (160, 40), (-0.5, 0.0)),
        (MotionKind.HAND_SHAKE, 2, (20, 20), (0.4, 0.2)),
        (MotionKind.FORWARD, 1, (0, 60), (0.5, 0.0)),
        (MotionKind.FORWARD, 3, (100, 80), (0.1, -0.4)),
    ]
    ratios = []
    for number, (kind, seed, at, velocity) in enumerate(ways):
        static = followed(camera(kind, seed), FRAMES)[1]
        over = patch(0.15, at, velocity, 5 + number)
        reconstructor, error, _ = followed(behind(camera(kind, seed), over, 0.8), FRAMES)
        ratios.append(error / static)
        status = reconstructor.status()
        figure(f"15 % moving, {kind} {seed}: ATE; static", f"{error:.2f} %; {static:.2f} %", str(status.state))
        assert error < 4 or status.state is not State.TRACK
    figure("15 % of the area moving, seven ways: median of the ratios", f"{np.median(ratios):.2f}", "< 1.5")
    assert np.median(ratios) < 1.5, ratios


def test_a_blank_wall_fills_the_view_for_a_while() -> None:
    """The wall ends what is known; behind it the camera finds its place again."""
    reconstructor, error, coverage = followed(behind(camera(), wall(350, 120), 4.0), 700)
    changes = reconstructor.odometry.changes
    assert reconstructor.status().state is State.TRACK, reconstructor.status().reason
    assert error < 3 and 0.6 < coverage < 0.97, (error, coverage)
    lost = [time for time, state, _ in changes if state is State.LOST]
    assert lost and 380 < lost[0] < 480, changes
    assert any(state is State.RELOC for time, state, _ in changes if time > lost[0]), changes
