"""`spiked baseline`: what pipelines for ordinary cameras make of a recording."""

import json
import time
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from spiked.baselines import ImageKind, PictureOptions, SpikePicture, interpolated, run_colmap, spike_pictures
from spiked.baselines.pictures import bin_pixels, picture_intrinsics
from spiked.errors import ConfigurationError, SpikedError
from spiked.recon import LossName, MapOptions, Options, Reconstructor
from spiked.recording import Recording
from spiked.trajectory import Trajectory
from spiked_service.cli import outputs
from spiked_service.cli import recording_flags as g
from spiked_service.cli.commands.reconstruct import MapOptionTexts, ProgressDisplay
from spiked_service.cli.console import messages, output, report_error, report_warning
from spiked_service.cli.flag_groups import with_groups
from spiked_service.results.map_folder import replacing
from spiked_service.results.recording_feed import reconstruct_recording
from spiked_service.settings.map_options import changed

RESULTS = "trajectory.tum", "report.json"
"""Files in OUT; with a map also scene.ply."""
TRUTH = "groundtruth.tum"
_STEPS = Options().steps
_LOSSES = {
    ImageKind.TFP: LossName.ACCUMULATION,
    ImageKind.TFI: LossName.INTERVAL,
    ImageKind.CHARGE: LossName.CHARGE,
}
"""What the map is fitted to. The accumulation image counts 32 frames whatever the window of the pictures."""


class PoseSource(StrEnum):
    """Where the poses come from."""

    COLMAP = "colmap"
    GIVEN = "given"


class MapSource(StrEnum):
    """What is made on the poses."""

    OURS = "ours"
    NONE = "none"


@dataclass(frozen=True)
class _Posed:
    trajectory: Trajectory
    report: dict[str, Any]


@dataclass(frozen=True)
class PictureFlags:
    """Which pictures are made of the spikes."""

    images: Annotated[
        ImageKind,
        typer.Option(
            help="Pictures made of spikes. tfp: mean of a window; tfi: reciprocal of the interval between the two "
            "spikes about its middle; charge: charge between the spikes nearest to its edges."
        ),
    ] = ImageKind.TFP
    window_frames: Annotated[
        int | None,
        typer.Option(help="Frames of a picture; by default the longest of 32, 16, 8, 4 that FILE has 35 of.", min=1),
    ] = None
    pictures: Annotated[
        int | None, typer.Option(help="Number of pictures for COLMAP, evenly spaced; by default 60.", min=2)
    ] = None

    def options(self) -> PictureOptions:
        """Raises ConfigurationError."""
        return PictureOptions(self.images, self.window_frames, self.pictures)


@dataclass(frozen=True)
class MapFlags:
    """How a map is fitted to them."""

    steps: Annotated[int, typer.Option(help="Gradient steps of the map.", min=0)] = _STEPS
    seed: Annotated[int, typer.Option(help="Of COLMAP and of the map.", min=0)] = 0
    threads: Annotated[int | None, typer.Option(help="All cores if not given.", min=1)] = None
    map_option: MapOptionTexts = None

    def options(self, pictures: PictureOptions, recording: Recording, poses: Trajectory) -> Options:
        """For a map of these pictures at these poses. Raises ConfigurationError."""
        return Options(
            window_frames=_window(pictures, recording),
            steps=self.steps,
            seed=self.seed,
            threads=self.threads,
            poses=poses,
            mapping=changed(MapOptions(sub_frames=0, loss=_LOSSES[pictures.kind]), self.map_option or []),
        )


@with_groups
def baseline(
    file: Annotated[Path, typer.Argument(help="A recording without gaps.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results; created if missing.")],
    poses: Annotated[
        PoseSource, typer.Option(help="colmap: structure from motion on the pictures; given: those of --given.")
    ] = PoseSource.COLMAP,
    map: Annotated[
        MapSource, typer.Option(help="ours: Gaussians fitted to the pictures at these poses; none: poses only.")
    ] = MapSource.OURS,
    given: Annotated[
        Path | None, typer.Option(help="TUM file of camera-to-world poses; by default groundtruth.tum beside FILE.")
    ] = None,
    all_frames: Annotated[
        bool,
        typer.Option(
            "--all-frames/--pictures-only",
            help="Interpolate poses of the frames between COLMAP's pictures, or write one frame of each picture alone.",
        ),
    ] = True,
    *,
    fit: MapFlags,
    made: PictureFlags,
    optics: g.OpticsFlags,
    geometry: g.GeometryFlags,
    profile: g.Profile = None,
) -> None:
    """Reconstruct a recording as one would without this program: COLMAP on pictures made of spikes.

    OUT has trajectory.tum, scene.ply and report.json as `spiked reconstruct` writes them, so that `spiked evaluate` and
    `spiked compare` score it. COLMAP (extra `spiked[colmap]`) takes the recording's own focal length and lens and holds
    them; pixels of a colour mosaic are averaged by 2x2. Poses of the frames between the pictures are interpolated. The
    map is fitted to pictures of the same kind (tfp: of 32 frames) and takes the camera as still during one. OUT/colmap
    is COLMAP's own project: the pictures, and the model in sparse/0.

    Examples:

    - `spiked baseline rec.dat -o out`

    - `spiked baseline rec.dat -o out --images charge --map none`

    - `spiked baseline rec.dat -o out --images tfi --poses given --given known.tum`
    """
    outputs.try_folder("--out", out, RESULTS)
    recording = g.open_described(file, geometry.stated(), profile).recording
    for warning in recording.warnings:
        report_warning(warning)
    recording = replace(recording, sensor=optics.of(recording.sensor))
    options = made.options()
    if poses is PoseSource.GIVEN:
        posed = _given(given or file.parent / TRUTH, all_frames=all_frames)
    else:
        posed = _by_colmap(recording, options, out, (fit.threads, fit.seed), all_frames=all_frames)
    report: dict[str, Any] = {"images": made.images, "poses": poses, "map": map, **posed.report}
    if map is MapSource.NONE:
        _write(out, posed.trajectory, {"frames": recording.frames, "baseline": report})
        output.print(f"{out}: {len(posed.trajectory)} poses for {recording.frames} frames, no map", markup=False)
        return
    chosen = fit.options(options, recording, posed.trajectory)
    _map(recording, Reconstructor(recording.sensor, chosen, recording=recording), out, report)


def _given(path: Path, *, all_frames: bool) -> _Posed:
    if not all_frames:
        raise ConfigurationError("--pictures-only is for COLMAP's poses: leave it out with --poses given")
    return _Posed(Trajectory.read_tum(path), {})


def _window(options: PictureOptions, recording: Recording) -> int:
    """Frames of a picture. As the length of the map's views it also keeps the map from compensating fast motion."""
    begin, end = options.windows(recording.frames)[0]
    return max(2, end - begin)


def _by_colmap(
    recording: Recording,
    options: PictureOptions,
    out: Path,
    threads_and_seed: tuple[int | None, int],
    *,
    all_frames: bool,
) -> _Posed:
    """Poses of all frames or of the pictures, and what the report says of them."""
    intrinsics = picture_intrinsics(recording.sensor)
    threads, seed = threads_and_seed
    begin = time.perf_counter()
    made: list[SpikePicture] = list(spike_pictures(recording, options))
    messages.print(f"COLMAP on {len(made)} pictures ({options.kind})", markup=False)
    with outputs.writing("--out", out):
        found = run_colmap(made, intrinsics, out / "colmap", threads=threads, seed=seed)
    poses, rate_hz = (found.rotations, found.centres), recording.sensor.frame_rate_hz
    path = interpolated(found.times, poses, frames=recording.frames, frame_rate_hz=rate_hz)
    if not all_frames:  # the middle of an even number of frames lies between two, where a truth has no pose
        frames = np.floor(path.times_s * rate_hz)
        seen = np.isin(frames, np.floor(found.times))
        path = Trajectory(path.times_s[seen], path.rotations[seen], path.centres[seen])
    if found.models > 1:
        report_warning(f"COLMAP made {found.models} models that it could not join; the largest one is taken")
    return _Posed(
        path,
        {
            "colmap": found.version,
            "pictures": len(made),
            "registered": len(found.times),
            "models": found.models,
            "points": found.points,
            "reprojection_px": found.reprojection_px,
            "window_frames": _window(options, recording),
            "bin_pixels": bin_pixels(recording.sensor),
            "seconds": time.perf_counter() - begin,
        },
    )


def _map(recording: Recording, reconstructor: Reconstructor, out: Path, report: dict[str, Any]) -> None:
    """Fit and write the map. Raises typer.Exit where there is none."""
    with ProgressDisplay(recording.frames) as display:
        reconstruct_recording(recording, reconstructor, progress=display.show, cancelled=lambda: False)
    for warning in reconstructor.warnings:
        report_warning(warning)
    path = reconstructor.trajectory()
    _write(out, path, {**reconstructor.report(), "baseline": report}, reconstructor)
    if reconstructor.failure is not None:
        report_error(SpikedError(f"no map was made: {reconstructor.failure}"))
        raise typer.Exit(1)
    splats = reconstructor.status().splats
    output.print(f"{out}: {len(path)} poses for {recording.frames} frames, {splats} splats", markup=False)


def _write(out: Path, trajectory: Trajectory, report: dict[str, Any], mapped: Reconstructor | None = None) -> None:
    with outputs.writing("--out", out), replacing(out) as making:
        if mapped is not None:
            mapped.scene().write_ply(making / "scene.ply", mapped.white)
        trajectory.write_tum(making / "trajectory.tum")
        (making / "report.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
