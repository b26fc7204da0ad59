"""Calibration of a lens by a board, on a simulated board that a hand-held camera looks at for two seconds."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.board import Board
from spiked.distortion import Distortion, LensModel
from spiked.errors import CalibrationError, ConfigurationError
from spiked.lens_calibration import BoardView, board_views, calibrate_lens
from spiked.recording import RecordingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.board import AroundBoard, BoardScene

BOARD, WIDTH, HEIGHT, FRAMES = Board(9, 6), 400, 250, 40_000
LENSES = {
    "none": Intrinsics(346.0, 346.0, 203.0, 123.0),
    "barrel": Intrinsics(346.0, 347.0, 203.0, 123.0, Distortion(LensModel.OPENCV, (-0.3, 0.1, 0.002, -0.001))),
    "fisheye": Intrinsics(191.0, 191.0, 197.0, 127.0, Distortion(LensModel.FISHEYE, (0.02, -0.01))),
}


class Later:
    """A path from some frame on."""

    def __init__(self, path: AroundBoard, first: int) -> None:
        self._path, self._first = path, first

    def poses(self, frames: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        return self._path.poses(np.asarray(frames, float) + self._first)


class TwoSeconds:
    """Two seconds of a recording at 20 kHz, of which only the frames that are read are simulated."""

    path, frames = Path("board.dat"), FRAMES

    def __init__(self, k: Intrinsics) -> None:
        self.sensor = Sensor(WIDTH, HEIGHT, 20_000.0, intrinsics=k)
        self._motion = AroundBoard.of(BOARD, k, WIDTH, HEIGHT, FRAMES, 0)
        self._scene = BoardScene(BOARD)

    def read(self, first: int, count: int) -> np.ndarray:
        camera = SimulatedCamera(self.sensor, first, Later(self._motion, first), self._scene, threads=2)
        return camera.next_frames(count)


@cache
def corners(lens: str, count: int = 300) -> list[BoardView]:
    """Corners with a noise of 0.05 px in 40 images, without simulated spikes."""
    k, rng = LENSES[lens], np.random.default_rng(3)
    path = AroundBoard.of(BOARD, k, WIDTH, HEIGHT, FRAMES, 0)
    views = []
    for frame in np.linspace(0, FRAMES - 1, 40):
        rotation, centre = (poses[0] for poses in path.poses([frame]))
        pixels = k.project((BOARD.corners - centre) @ rotation)
        seen = ((pixels > 5) & (pixels < [WIDTH - 5, HEIGHT - 5])).all(1)
        if seen.sum() > 10:
            noisy = pixels[seen] + rng.normal(scale=0.05, size=(int(seen.sum()), 2))
            views.append(BoardView(frame, np.flatnonzero(seen), noisy))
    return views


def deviations(k: Intrinsics) -> dict[str, float]:
    return {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, **({} if k.distortion is None else k.distortion.named())}


@pytest.mark.parametrize("lens", LENSES)
def test_the_lens_is_found_within_its_deviations(lens: str) -> None:
    known = LENSES[lens]
    found = calibrate_lens(corners(lens), BOARD, WIDTH, HEIGHT)
    if known.distortion is not None:
        assert found.intrinsics.distortion is not None
        assert found.intrinsics.distortion.model is known.distortion.model
    truth, values = deviations(known), deviations(found.intrinsics)
    errors = [abs(values[name] - truth.get(name, 0.0)) / sigma for name, sigma in found.sigmas.items()]
    assert max(errors) < 4, (values, found.sigmas)
    assert np.sqrt(np.mean(np.square(errors))) > 0.2  # and they are not far too large
    assert found.rms_px == pytest.approx(0.05 * np.sqrt(2), rel=0.1)


def test_corners_that_are_wrong_are_left_out() -> None:
    views = [BoardView(view.frame, view.numbers, view.pixels.copy()) for view in corners("barrel")]
    for view in views[::3]:
        view.pixels[0] += 3
    found = calibrate_lens(views, BOARD, WIDTH, HEIGHT, LensModel.OPENCV)
    assert found.rejected >= len(views[::3])
    assert found.intrinsics.fx == pytest.approx(346, rel=1e-3)


def test_corners_in_the_middle_only_are_warned_about() -> None:
    middle = [WIDTH / 2, HEIGHT / 2]
    views = []
    for view in corners("barrel"):
        near = (np.abs(view.pixels - middle) < [100, 62]).all(1)
        if near.sum() >= 8:
            views.append(BoardView(view.frame, view.numbers[near], view.pixels[near]))
    found = calibrate_lens(views, BOARD, WIDTH, HEIGHT, LensModel.OPENCV)
    assert found.cover < 0.4 and "into its corners" in found.warnings()[0]
    assert not calibrate_lens(corners("barrel"), BOARD, WIDTH, HEIGHT, LensModel.OPENCV).warnings()


@pytest.mark.slow
@pytest.mark.validation
def test_two_seconds_by_hand_are_enough(figure: Any) -> None:
    known = LENSES["barrel"]
    views = board_views(TwoSeconds(known), BOARD, views=30)  # type: ignore[arg-type]
    found = calibrate_lens(views, BOARD, WIDTH, HEIGHT)
    focal = 100 * abs(found.intrinsics.fx / known.fx - 1)
    centre = float(np.hypot(found.intrinsics.cx - known.cx, found.intrinsics.cy - known.cy))
    told = f"{focal:.3f} %; {centre:.2f} px; {found.rms_px:.3f} px"
    figure("board, 2 s by hand: focal length; centre; reprojection", told, "<= 0.1 %; <= 0.3 px; <= 0.1 px")
    assert focal <= 0.1 and centre <= 0.3 and found.rms_px <= 0.1


def test_a_recording_without_a_board_is_told() -> None:
    with pytest.raises(CalibrationError, match=r"found in 0 images, and 8 are needed.*9x6 squares"):
        calibrate_lens([], BOARD, WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("text", "markers", "said"),
    [
        ("9", "4x4_100", "COLUMNSxROWS"),
        ("2x6", "4x4_100", "3 to 60"),
        ("9x6", "5x5", "choose one of .*4x4_100"),
        ("30x20", "4x4_50", "has 300 markers, and 4x4_50 only 50"),
    ],
)
def test_a_board_that_cannot_be_is_refused(text: str, markers: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        Board.parse(text, markers)


def test_the_command_writes_a_lens_that_other_commands_take(tmp_path: Path) -> None:
    recording, known = TwoSeconds(LENSES["barrel"]), LENSES["barrel"]
    with RecordingWriter(tmp_path / "board.dat", recording.sensor) as writer:
        for first in range(0, FRAMES, FRAMES // 12):  # twelve moments of the two seconds
            writer.append(recording.read(first, 64))
    out = tmp_path / "lens.json"
    command = ["calibrate", str(tmp_path / "board.dat"), "--board", "9x6", "-o", str(out), "--model", "opencv"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert "fx 34" in done.output and "(+- " in done.output
    said = json.loads(out.read_text())
    assert said["intrinsics"]["distortion"]["k1"] == pytest.approx(-0.3, abs=0.05)
    assert said["intrinsics"]["fx"] == pytest.approx(known.fx, rel=0.01)
    assert said["sigmas"]["fx"] > 0 and said["reprojection_px"] < 0.15
    picture = cv2.imread(str(out.with_suffix(".png")))
    assert picture.shape[1] >= 800 and (picture != 255).any()
    simulated = ["simulate", "-o", str(tmp_path / "room"), "--frames", "8", "--views", "0", "--intrinsics", str(out)]
    assert CliRunner().invoke(app, simulated).exit_code == 0
    optics = json.loads((tmp_path / "room" / "simulated.json").read_text())["intrinsics"]
    assert optics == said["intrinsics"]
