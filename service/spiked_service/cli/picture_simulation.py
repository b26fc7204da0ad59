"""`spiked simulate --video`: spikes from a video or a folder of images."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

from spiked.errors import ConfigurationError
from spiked.sensor import Mosaic, Response, Sensor
from spiked.simulate import NoiseOptions, SpikeSensor
from spiked.simulate.camera import DEFAULT_GAIN, LONG_STEP_PX
from spiked.simulate.pictures.light import Framing, Sites, Transfer
from spiked.simulate.pictures.motion import Spacing
from spiked.simulate.pictures.poses import read_poses
from spiked.simulate.pictures.reading import Pictures, open_pictures
from spiked.simulate.pictures.record import (
    GHOST_PX,
    Interpolation,
    PictureLight,
    PicturePath,
    PictureSimulation,
    simulate_pictures,
)
from spiked.simulate.record import check_empty
from spiked_service.cli.console import messages, output, report_warning
from spiked_service.cli.recording_flags import with_optics

Progress = Callable[[str, int, str], AbstractContextManager[Callable[[int], None]]]
"""Shows what is done, of how many, and their name."""


@dataclass(frozen=True)
class VideoOptions:
    """What the command line says of a simulation from pictures; None: not stated."""

    video: Path
    out: Path
    name: str
    poses: Path | None
    picture_rate: float | None
    gamma: str
    interpolation: Interpolation
    picture_step: float | None
    frames: int | None
    width: int | None
    height: int | None
    rate: float
    mosaic: Mosaic | None
    response: Response
    fov: float | None
    intrinsics: str | None
    distortion: str | None
    gain: float | None
    views: int
    seed: int
    noise: NoiseOptions
    threads: int


def simulate_video(options: VideoOptions, progress: Progress) -> None:
    """Make the recording, and say what the pictures are. Raises SpikedError."""
    if options.gain is not None and not options.gain > 0:
        raise ConfigurationError(f"--gain {options.gain:g} must be a positive number of spikes a frame")
    check_empty(options.out)
    transfer = Transfer.parse(options.gamma)
    pictures = open_pictures(options.video, options.picture_rate)
    first = next(iter(pictures.read()))
    size = (first.shape[1], first.shape[0])
    framing = Framing.of(size, options.width, options.height)
    poses, optics = (None, None) if options.poses is None else read_poses(options.poses, pictures, size)
    sensor = Sensor(framing.width, framing.height, options.rate, mosaic=options.mosaic, response=options.response)
    if optics is not None:
        sensor = replace(sensor, intrinsics=framing.intrinsics(optics))
    sensor = with_optics(sensor, options.fov, options.intrinsics, options.distortion)
    sites = Sites(options.mosaic, DEFAULT_GAIN if options.gain is None else options.gain)
    light = PictureLight(pictures, framing, transfer, sites, options.rate)
    path = None if poses is None else PicturePath.of(poses, light)
    _describe(pictures, light)
    with progress("measuring motion", len(pictures.times_s), "pictures") as show:
        spacing = light.spacing(show)
    _describe_spacing(spacing, options.interpolation)
    spikes = SpikeSensor(sensor, options.seed, options.noise.noise(), options.noise.lighting(), threads=options.threads)
    simulation = PictureSimulation(
        light,
        sensor,
        spikes,
        light.frames if options.frames is None else options.frames,
        spacing,
        options.interpolation,
        LONG_STEP_PX if options.picture_step is None else options.picture_step,
        path,
        options.views,
    )
    with progress("simulating", simulation.frames, "frames") as show:
        data = simulate_pictures(simulation, options.out, options.name, show)
    _describe_result(data, simulation)


def _describe(pictures: Pictures, light: PictureLight) -> None:
    times = pictures.times_s
    seconds = float(times[-1] - times[0])
    messages.print(
        f"{pictures.path}: {len(times)} pictures, {(len(times) - 1) / seconds:.6g} a second for {seconds:.6g} s; "
        f"{light.framing}; values are taken as {light.transfer} (--gamma)",
        markup=False,
    )


def _describe_spacing(spacing: Spacing, interpolation: Interpolation) -> None:
    messages.print(
        f"consecutive pictures are {spacing.median_px:.3g} px apart (median; 95 %: {spacing.p95_px:.3g} px; "
        f"{spacing.pairs} pairs, {spacing.followed:.0%} of the corners followed)",
        markup=False,
    )
    if spacing.followed < 0.5:
        report_warning(
            "most corners of a picture are not found in the next one: the motion may be larger than was measured"
        )
    if spacing.p95_px <= GHOST_PX:
        return
    apart = f"some pictures are more than {GHOST_PX:g} px apart"
    if interpolation is Interpolation.LINEAR:
        report_warning(
            f"{apart}: light that runs evenly between them shows edges twice; take more pictures a second, or move "
            "them along the optical flow with --interpolation motion"
        )
    else:
        report_warning(
            f"{apart}: what is between them follows the optical flow, which is wrong where things hide each other; "
            "take more pictures a second"
        )


def _describe_result(data: Path, simulation: PictureSimulation) -> None:
    told = f"{data}: {simulation.frames} frames, {simulation.sensor.width}x{simulation.sensor.height}"
    if simulation.path is not None:
        known = len(simulation.path.frames(simulation.frames))
        told += f", ground truth of {known} of them in {data.parent / 'groundtruth.tum'}"
    if simulation.view_numbers:
        aside = "left aside" if simulation.held_out else "part of the light, too: leaving them aside would make ghosts"
        told += f", {len(simulation.view_numbers)} views ({aside})"
    if simulation.sensor.intrinsics is None:
        told += "; the optics are not known, --fov states them"
    output.print(told, markup=False)
