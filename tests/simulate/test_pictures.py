"""Spikes from pictures: the charge is that of the light between them, at any rate, and what is wrong is named."""

import json
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.recording import open_recording
from spiked.sensor import Intrinsics, Mosaic, Sensor
from spiked.simulate.pictures.light import Framing, Node, Sites, Transfer, spans_between
from spiked.simulate.pictures.motion import corners_moved, moved_nodes, shown
from spiked.simulate.pictures.reading import open_pictures
from spiked.trajectory import Trajectory

PERFECT = (
    "--electrons-a-spike", "1e12", "--reset-noise", "0", "--threshold-jitter", "0", "--dark", "0", "--dark-spread", "0",
    "--capacitance-mismatch", "0", "--reset-bias", "0", "--gain", "1",
)  # fmt: skip
"""Options of a sensor that only integrates, one spike a frame of white."""


def simulate(out: Path, video: Path, *options: object) -> Any:
    return CliRunner().invoke(app, ["simulate", "-o", str(out), "--video", str(video), *map(str, options)])


def bits_of(out: Path) -> NDArray[np.uint8]:
    """Upright bits [frames, height, width]."""
    recording = open_recording(out / "simulated.dat")
    stored = np.array(recording.read(0, recording.frames))
    bits = np.unpackbits(stored, axis=1, bitorder="little")
    return bits.reshape(-1, recording.sensor.height, recording.sensor.width)[:, ::-1]


def write_pictures(folder: Path, pictures: Sequence[NDArray[np.generic]], names: Sequence[str] = ()) -> Path:
    folder.mkdir()
    for number, picture in enumerate(pictures):
        stored = picture[..., ::-1] if picture.ndim == 3 else picture
        assert cv2.imwrite(str(folder / (names[number] if names else f"{number}.png")), stored)
    return folder


def texture(height: int = 100, width: int = 160, seed: int = 0) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed).uniform(0, 1, (height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray((smooth - smooth.min()) / (smooth.max() - smooth.min()))


@pytest.mark.parametrize(
    ("gamma", "light"), [("linear", 0.6), ("2.2", 0.6**2.2), ("srgb", ((0.6 + 0.055) / 1.055) ** 2.4)]
)
def test_a_constant_picture_fires_at_the_rate_of_its_light(tmp_path: Path, gamma: str, light: float) -> None:
    folder = write_pictures(tmp_path / "pictures", [np.full((8, 16), round(0.6 * 255), np.uint8)] * 2)
    done = simulate(tmp_path / "out", folder, "--picture-rate", 20, "--gamma", gamma, *PERFECT)
    assert done.exit_code == 0, done.output
    bits = bits_of(tmp_path / "out")
    assert len(bits) == 1000
    assert bits.mean() == pytest.approx(light, abs=1e-3)


@pytest.mark.parametrize("rate", [1000.0, 20_000.0])
def test_light_runs_evenly_from_picture_to_picture(tmp_path: Path, rate: float) -> None:
    """The charge after a time is the integral of a ramp up and one down, with pictures inside of frames, too."""
    ends = [np.full((8, 16), value, np.uint16) for value in (0, 52_428, 13_107)]  # 0, 0.8, 0.2
    folder = write_pictures(tmp_path / "pictures", ends)
    times = [10.0, 10.03333, 10.1]
    (folder / "times.txt").write_text("# seconds\n" + "\n".join(map(str, times)) + "\n")
    assert simulate(tmp_path / "out", folder, "--gamma", "linear", "--rate", rate, *PERFECT).exit_code == 0
    bits = bits_of(tmp_path / "out")
    assert len(bits) == rate * 0.1
    fine = np.interp((np.arange(100_000) + 0.5) / 1e6, np.array(times) - 10, [0, 0.8, 0.2])
    charge = np.cumsum(fine.reshape(len(bits), -1).mean(1))
    assert np.abs(bits.reshape(len(bits), -1).cumsum(0) - charge[:, None]).max() <= 1 + 1e-3
    assert np.abs(bits.reshape(len(bits), -1).cumsum(0).mean(1) - charge).max() < 0.25  # phases are uniform


def test_frames_across_pictures_get_the_exact_mean() -> None:
    """Pictures at any times, several in a frame or many frames apart."""
    rng = np.random.default_rng(0)
    times = np.concatenate([[0], np.cumsum(rng.uniform(0.1, 3, 40))])
    values = rng.uniform(0, 1, len(times)).astype(np.float32)
    nodes = (Node(time, np.full((1, 8), value, np.float32)) for time, value in zip(times, values, strict=True))
    spans = list(spans_between(nodes, Sites(None, 2.0)))
    means = np.concatenate([span.first[0, 0] + span.weights * (span.last - span.first)[0, 0] for span in spans])
    assert len(means) == int(times[-1])
    fine = np.interp((np.arange(len(means) * 10_000) + 0.5) / 10_000, times, values)
    assert means == pytest.approx(2 * fine.reshape(len(means), -1).mean(1), abs=1e-6)


@pytest.mark.parametrize("mosaic", Mosaic)
def test_colours_land_on_the_sites_of_the_mosaic(tmp_path: Path, mosaic: Mosaic) -> None:
    colours = np.array([0.9, 0.5, 0.1])
    picture = np.broadcast_to(np.round(colours * 65_535), (8, 16, 3)).astype(np.uint16)
    folder = write_pictures(tmp_path / "pictures", [picture] * 2, ["1.5.png", "1.525.png"])
    done = simulate(tmp_path / "out", folder, "--gamma", "linear", "--mosaic", mosaic, *PERFECT)
    assert done.exit_code == 0, done.output
    rates = bits_of(tmp_path / "out").mean(0)
    for row, column, letter in zip((0, 0, 1, 1), (0, 1, 0, 1), mosaic.value, strict=True):
        assert rates[row::2, column::2] == pytest.approx(colours["RGB".index(letter)], abs=3e-3)


def moving(count: int, step: float) -> list[NDArray[np.uint8]]:
    """A texture that moves to the left by `step` pixels from picture to picture, in colour."""
    wide = texture(width=240)
    grey = [
        cv2.warpAffine(wide, np.float32([[1, 0, -step * k], [0, 1, 0]]), (160, 100), flags=cv2.INTER_CUBIC)
        for k in range(count)
    ]
    return [np.repeat(np.round(255 * np.clip(one, 0, 1)).astype(np.uint8)[..., None], 3, 2) for one in grey]


def write_video(path: Path, pictures: Sequence[NDArray[np.uint8]], rate: float) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), rate, pictures[0].shape[1::-1])
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


@pytest.mark.parametrize("kind", ["avi", "mkv"])
def test_a_video_is_read_with_its_times_and_poses(tmp_path: Path, kind: str) -> None:
    """Matroska rounds times to milliseconds; of a constant rate they are exact again."""
    pictures = moving(9, 0.3)
    video = write_video(tmp_path / f"video.{kind}", pictures, 240.0)
    read = open_pictures(video)
    assert read.times_s == pytest.approx(np.arange(9) / 240)
    assert all(np.array_equal(one, other) for one, other in zip(read.read(), pictures, strict=True))

    times = np.array([1, 3, 7]) / 240
    centres = np.array([[0, 0, 0], [1, 0, 0], [3, 2, 0]])
    Trajectory(times, np.tile(np.eye(3), (3, 1, 1)), centres).write_tum(tmp_path / "poses.tum")
    done = simulate(tmp_path / "out", video, "--poses", tmp_path / "poses.tum", "--views", 2, "--fov", 60)
    assert done.exit_code == 0, done.output
    assert "0.29" in done.stderr and "edges twice" not in done.stderr
    assert "2 views (left aside)" in done.stdout
    truth = Trajectory.read_tum(tmp_path / "out" / "groundtruth.tum")
    middles = (np.arange(666) + 0.5) / 20_000
    known = middles[(middles > times[0] - 1e-6) & (middles < times[-1] + 1e-6)]
    assert truth.times_s == pytest.approx(known, abs=1e-9)
    assert truth.centres[:, 0] == pytest.approx(np.interp(known, times, centres[:, 0]), abs=1e-6)

    views = json.loads((tmp_path / "out" / "views.json").read_text())["views"]
    for view in views:
        number = round(view["timestamp"] * 240)
        assert view["c2w"][0][3] == pytest.approx(np.interp(view["timestamp"], times, centres[:, 0]))
        shown = cv2.imread(str(tmp_path / "out" / view["file"]), cv2.IMREAD_GRAYSCALE)
        expected = Transfer.parse("srgb").linear(pictures[number])[..., 0]
        assert np.abs(shown / 255 - expected).max() < 0.5 / 255 + 1e-6
    told = json.loads((tmp_path / "out" / "simulated.json").read_text())["simulation"]["pictures"]
    assert (told["count"], told["transfer"], told["interpolation"]) == (9, "sRGB", "linear")
    assert told["spacing"]["median_px"] == pytest.approx(0.3, abs=0.02)


def test_poses_of_nerfstudio_have_names_and_optics(tmp_path: Path) -> None:
    folder = write_pictures(tmp_path / "pictures", moving(4, 0.3), [f"{k / 100 + 5:.2f}.png" for k in range(4)])
    path = Trajectory(np.arange(4) / 100 + 5, np.stack([np.eye(3)] * 4), np.eye(4)[:, :3])
    optics = Intrinsics(90.0, 91.0, 80.0, 50.0)
    text = path.nerfstudio(Sensor(160, 100, 100.0, intrinsics=optics))
    assert "5.010000000.png" in text
    (tmp_path / "transforms.json").write_text(re.sub(r"(\d\.\d\d)0{7}", r"\1", text))
    done = simulate(tmp_path / "out", folder, "--poses", tmp_path / "transforms.json", "--width", 80)
    assert done.exit_code == 0, done.output
    truth = Trajectory.read_tum(tmp_path / "out" / "groundtruth.tum")
    assert len(truth) == 600
    expected = np.stack([np.interp(truth.times_s, np.arange(4) / 100, column) for column in path.centres.T], 1)
    assert truth.centres == pytest.approx(expected, abs=1e-6)
    assert truth.rotations[7] == pytest.approx(np.eye(3), abs=1e-9)
    sensor = open_recording(tmp_path / "out" / "simulated.dat").sensor
    assert (sensor.width, sensor.height, sensor.intrinsics) == (80, 50, Intrinsics(45.0, 45.5, 40.0, 25.0))
    (tmp_path / "transforms.json").write_text('{"frames": [{"file_path": "a.png"}, {}]}')
    wrong = simulate(tmp_path / "wrong", folder, "--poses", tmp_path / "transforms.json")
    assert "frames.0.transform_matrix" in str(wrong.exception)


def test_slow_motion_is_taken_at_the_rate_of_the_camera(tmp_path: Path) -> None:
    video = write_video(tmp_path / "slow.avi", moving(4, 0.3), 30.0)
    assert open_pictures(video, 960.0).times_s == pytest.approx(np.arange(4) / 960)


def test_ghosts_are_warned_of_and_motion_avoids_them(tmp_path: Path) -> None:
    """Two pictures 4 px apart: the light halfway is that of a texture moved by half of it."""
    pictures = moving(2, 4.0)
    video = write_video(tmp_path / "video.avi", pictures, 100.0)
    done = simulate(tmp_path / "out", video, "--frames", 20)
    assert done.exit_code == 0, done.output
    assert "4 px apart" in done.stderr and "shows edges twice" in done.stderr
    done = simulate(tmp_path / "moved", video, "--frames", 20, "--interpolation", "motion")
    assert done.exit_code == 0 and "follows the optical flow" in done.stderr

    first, last = (one[..., 0].astype(np.float32) / 255 for one in pictures)
    nodes = list(moved_nodes(iter([Node(0.0, first), Node(200.0, last)]), 0.5))
    middle = nodes[len(nodes) // 2]
    share = middle.frame / 200
    halfway = moving(2, 4 * share)[1][..., 0].astype(np.float32) / 255
    inside = np.s_[8:-8, 8:-8]
    faded = np.sqrt(np.square(first + share * (last - first) - halfway)[inside].mean())
    moved = np.sqrt(np.square(middle.light - halfway)[inside].mean())
    assert moved < 0.25 * faded
    steps = [corners_moved(shown(a.light), shown(b.light))[0] for a, b in pairwise(nodes)]
    assert np.median(np.concatenate(steps)) < 0.6


def test_pictures_cover_the_sensor_and_optics_follow() -> None:
    framing = Framing.of((640, 480), 400, 250)
    assert (framing.scaled, str(framing)) == (
        (400, 300), "640x480 pixels, scaled by 0.625, the middle 400x250 of 400x300 cut out"
    )  # fmt: skip
    optics = framing.intrinsics(Intrinsics(500.0, 500.0, 320.0, 240.0))
    assert (optics.fx, optics.fy, optics.cx, optics.cy) == pytest.approx((312.5, 312.5, 200, 125))
    ramp = np.broadcast_to(np.linspace(0, 1, 640, dtype=np.float32), (480, 640))
    assert framing(ramp).shape == (250, 400)
    assert framing(ramp).mean() == pytest.approx(0.5, abs=1e-3)
    whole = Framing.of((403, 250), None, None)
    assert (whole.width, whole.height, whole.scaled) == (400, 250, (403, 250))
    assert Framing.of((640, 480), 320, None).height == 240


def test_times_come_from_names_or_a_file(tmp_path: Path) -> None:
    pictures = [np.zeros((8, 8), np.uint8)] * 3
    names = [f"{1_403_636_579_763_555_584 + k * 5_000_000}.png" for k in range(3)]
    nanoseconds = open_pictures(write_pictures(tmp_path / "ns", pictures, names)).times_s
    assert np.diff(nanoseconds) == pytest.approx(0.005, abs=1e-6)
    folder = write_pictures(tmp_path / "table", pictures, ["b.png", "c.png", "a.png"])
    (folder / "times.csv").write_text("time,name\n0.1,c.png\n0.2,a.png\n0.4,b.png\n")
    table = open_pictures(folder)
    assert (table.names, table.times_s.tolist()) == (["c.png", "a.png", "b.png"], [0.1, 0.2, 0.4])
    numbered = write_pictures(tmp_path / "numbered", pictures, ["f2.png", "f10.png", "f1.png"])
    assert open_pictures(numbered, 50).names == ["f1.png", "f2.png", "f10.png"]


def bad(folder: Path, kind: str) -> Path:
    grey = np.zeros((8, 16), np.uint8)
    match kind:
        case "nothing":
            return folder / "nothing.mp4"
        case "empty":
            return write_pictures(folder / kind, [])
        case "one":
            return write_pictures(folder / kind, [grey])
        case "names":
            return write_pictures(folder / kind, [grey, grey], ["left.png", "right.png"])
        case "sizes":
            return write_pictures(folder / kind, [grey, grey[:, :8]], ["0.0.png", "0.1.png"])
        case "unreadable":
            made = write_pictures(folder / kind, [grey], ["0.0.png"])
            (made / "0.1.png").write_bytes(b"no image")
            return made
        case "no video":
            (folder / "no.mp4").write_bytes(b"no video" * 100)
            return folder / "no.mp4"
        case "one of a video":
            return write_video(folder / "one.avi", [np.zeros((8, 16, 3), np.uint8)], 10)
        case "small":
            return write_pictures(folder / kind, [grey[:, :4], grey[:, :4]], ["0.0.png", "0.1.png"])
    made = write_pictures(folder / kind, [grey, grey])
    (made / "times.txt").write_text({"order": "1.0\n0.5\n", "text": "1.0\nsoon\n", "few": "1.0\n"}[kind])
    return made


@pytest.mark.parametrize(
    ("kind", "problem"),
    [
        ("nothing", "there is no video or folder"),
        ("empty", "has no pictures"),
        ("one", "has one picture"),
        ("names", "say no times; give --picture-rate"),
        ("sizes", r"0\.1\.png is 8x8 grey and the pictures before it are 16x8 grey"),
        ("unreadable", r"0\.1\.png is no image"),
        ("no video", "no video that OpenCV can decode"),
        ("one of a video", "has one picture"),
        ("small", "too small"),
        ("order", r"times do not increase: 1\.png at 0\.500000 s follows 0\.png"),
        ("text", "line 2: expected a time in seconds, got 'soon'"),
        ("few", "has 1 times and 2 names"),
    ],
)
def test_pictures_that_cannot_be_used_are_named(tmp_path: Path, kind: str, problem: str) -> None:
    done = simulate(tmp_path / "out", bad(tmp_path, kind))
    assert done.exit_code != 0
    assert done.exception is not None and re.search(problem, str(done.exception)), done.exception
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--gamma", "film"], "write srgb, linear, or an exponent"),
        (["--frames", "5000"], "5000 frames are asked for, and the pictures last for 2000"),
        (["--views", "2"], "give --poses"),
        (["--flow", "0.2"], "leave out --flow"),
        (["--gain", "0"], "--gain 0"),
    ],
)
def test_options_that_cannot_be_are_named(tmp_path: Path, options: list[str], problem: str) -> None:
    folder = write_pictures(tmp_path / "pictures", [np.zeros((8, 16), np.uint8)] * 2, ["0.0.png", "0.1.png"])
    done = simulate(tmp_path / "out", folder, *options)
    assert done.exit_code != 0 and problem in str(done.exception)
    Trajectory(np.array([5.0, 6.0]), np.tile(np.eye(3), (2, 1, 1)), np.eye(3)[:2]).write_tum(tmp_path / "late.tum")
    late = simulate(tmp_path / "out", folder, "--poses", tmp_path / "late.tum")
    assert "need the clock of the pictures" in str(late.exception)
    assert not (tmp_path / "out").exists()
