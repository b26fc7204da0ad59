"""`spiked reconstruct`: a recording in; scene, trajectory, report and pictures out."""

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from spiked.calibration import Calibration
from spiked.errors import ConfigurationError
from spiked.recon import Options, Reconstructor, Status
from spiked.recon.colour import detect
from spiked.recon.views import Windows
from spiked.recording import Recording
from spiked.sensor import Mosaic, Sensor
from spiked.trajectory import Trajectory
from spiked_service import geometry as g
from spiked_service.console import messages, output, report_warning
from spiked_service.offline import reconstruct_recording

if TYPE_CHECKING:
    from spiked_service.watch import Watch

INTERRUPTED = 130
_STDERR = 2
_FEED_SHARE = 0.3
"""Part of the progress bar for feeding; the refinement has the rest."""


def reconstruct(
    file: Annotated[Path, typer.Argument(help="A recording.", readable=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results; made if it is not there.")],
    poses: Annotated[Path | None, typer.Option(help="Known poses, a TUM file, camera-to-world.")] = None,
    seconds: Annotated[
        float | None, typer.Option(help="Be done after about so long, with fewer steps.", min=0.0)
    ] = None,
    steps: Annotated[int, typer.Option(help="Gradient steps of the final refinement.", min=0)] = Options().steps,
    seed: Annotated[int, typer.Option(help="The same seed gives the same result.")] = 0,
    threads: Annotated[int | None, typer.Option(help="Threads of the rasteriser; all cores if not given.")] = None,
    watch: Annotated[bool, typer.Option("--watch", help="Serve a page that shows it while it works.")] = False,
    watch_port: Annotated[int, typer.Option(help="Its port on this machine; 0 takes a free one.", min=0)] = 8651,
    fov: g.Fov = None,
    intrinsics: g.IntrinsicsText = None,
    width: g.Width = None,
    height: g.Height = None,
    rate: g.Rate = None,
    layout: g.FrameLayout = None,
    bit_order: g.Bits = None,
    flipped: g.Flipped = None,
    mosaic: g.ColoursOrAuto = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Of `spiked calibrate`: gains, dark rates, dead pixels.")
    ] = None,
) -> None:
    """Reconstruct the camera's trajectory and a Gaussian scene from a recording.

    OUT then holds scene.ply (3DGS fields), trajectory.tum (a pose for every frame that has one), report.json and
    overview.png. Ctrl-C keeps what there is: OUT is written from the current state, and the exit code is 130.
    Without a pose to show the exit code is 1 and report.json says why.

    Examples:

    - `spiked reconstruct rec.dat -o out`

    - `spiked reconstruct rec.dat -o out --fov 60 --seconds 120`

    - `spiked reconstruct rec.dat -o out --poses known.tum`
    """
    colours = None if mosaic in (None, g.MosaicChoice.AUTO) else Mosaic(mosaic)
    recording = g.Geometry(width, height, rate, layout, bit_order, flipped, colours).open(file)
    for warning in recording.warnings:
        report_warning(warning)
    sensor = g.with_optics(recording.sensor, fov, intrinsics)
    if mosaic is g.MosaicChoice.AUTO:
        sensor = _by_pixels(recording, sensor)
    known = None if poses is None else Trajectory.read_tum(poses)
    measured = None if calibration is None else Calibration.read(calibration)
    reconstructor = Reconstructor(
        sensor, Options(seed=seed, steps=steps, threads=threads, poses=known, calibration=measured)
    )
    _check_folder(out)
    total = recording.capture_index(recording.frames - 1) + 1
    page = _watched(file.name, watch_port) if watch else None
    with _interruptible() as interrupt, _Display(total) as display:

        def show(status: Status) -> None:
            display.show(status)
            if page is not None:
                page.show(reconstructor, status)

        reconstruct_recording(recording, reconstructor, progress=show, cancelled=interrupt.is_set, budget_s=seconds)
    if page is not None:
        page.close()
    _write(reconstructor, out, file.name, display.curve)
    for warning in reconstructor.warnings:
        report_warning(warning)
    status = reconstructor.status()
    poses_found = len(reconstructor.trajectory())
    output.print(f"{out}: {poses_found} poses for {status.frames} frames, {status.splats} splats, {status.state}")
    if interrupt.is_set():
        raise typer.Exit(INTERRUPTED)
    if poses_found == 0:
        report_warning(f"no pose was found: {status.reason}")
        raise typer.Exit(1)


def _by_pixels(recording: Recording, sensor: Sensor) -> Sensor:
    """The sensor with the mosaic that the first frames show."""
    frames = recording.read(0, min(recording.frames, 160))
    windows = Windows(sensor, min(32, len(frames)))
    view = next(iter([*windows.feed(0, frames), *windows.flush()]))
    found = detect(view.rate, sensor.mosaic)
    if found is not sensor.mosaic:
        report_warning(f"by its pixels the mosaic is {found}, not {sensor.mosaic}; red and blue may still be exchanged")
    return replace(sensor, mosaic=found)


def _watched(title: str, port: int) -> "Watch":
    from spiked_service.watch import Watch  # a web server is not needed without it

    page = Watch(title, port)
    messages.print(f"watch it at {page.url}", markup=False)
    return page


class _Interrupt:
    """Set by the first Ctrl-C or SIGTERM; the second one ends the program."""

    def __init__(self) -> None:
        self._set = False

    def is_set(self) -> bool:
        return self._set

    def handle(self, number: int, frame: FrameType | None) -> None:
        if self._set:
            raise KeyboardInterrupt
        self._set = True
        # Past Python's own buffers: the signal may have come in the middle of a line that is being written there.
        os.write(_STDERR, b"stopping; writing what there is (Ctrl-C again to leave at once)\n")


@contextmanager
def _interruptible() -> Iterator[_Interrupt]:
    interrupt = _Interrupt()
    before = {number: signal.signal(number, interrupt.handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupt
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Display:
    """A live line: stage, frames, state, loss, splats, time left. Off a terminal, a plain line every few seconds."""

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._bar = Progress(
            TextColumn("{task.description:9s}"),
            BarColumn(bar_width=28),
            TextColumn("{task.fields[figures]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=messages,
            disable=not messages.is_terminal,
        )
        self._task = self._bar.add_task("waiting", total=1.0, figures="")
        self._begin = self._last = time.monotonic()
        self._stage = ""
        self.curve: list[tuple[float, float]] = []
        """Seconds since the beginning and loss, as they came."""

    def __enter__(self) -> "_Display":
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def show(self, status: Status) -> None:
        """Show where the reconstruction stands."""
        if status.loss is not None:
            self.curve.append((time.monotonic() - self._begin, status.loss))
        loss = "" if status.loss is None else f"  loss {status.loss:.2e}"
        figures = f"{status.frames}/{self._frames} frames  {status.state}{loss}  {status.splats} splats"
        fed = min(1.0, status.frames / max(self._frames, 1))
        done = _FEED_SHARE * fed + (1 - _FEED_SHARE) * status.progress
        self._bar.update(
            self._task, description=status.stage, completed=1.0 if status.stage == "done" else done, figures=figures
        )
        if not messages.is_terminal and (status.stage != self._stage or time.monotonic() - self._last > 5):
            self._last, self._stage = time.monotonic(), status.stage
            messages.print(f"{status.stage}: {figures}  {100 * status.progress:.0f} % refined", markup=False)


def _check_folder(out: Path) -> None:
    """Before minutes of work: whether the results can be written. Nothing is created."""
    if out.exists() and not out.is_dir():
        raise ConfigurationError(f"--out {out} is a file; name a folder")
    nearest = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    if not nearest.is_dir():
        raise ConfigurationError(f"--out {out} cannot be made: {nearest} is a file")


def _write(reconstructor: Reconstructor, out: Path, title: str, curve: list[tuple[float, float]]) -> None:
    from spiked_service.overview import draw_overview  # matplotlib takes longer to load than most commands run

    try:
        out.mkdir(parents=True, exist_ok=True)
        reconstructor.scene().write_ply(out / "scene.ply", reconstructor.white)
        reconstructor.trajectory().write_tum(out / "trajectory.tum")
        (out / "report.json").write_text(json.dumps(reconstructor.report(), indent=1), encoding="utf-8")
        draw_overview(reconstructor, title, curve, out / "overview.png")
    except OSError as error:
        raise ConfigurationError(
            f"cannot write the results to {out}: {error.strerror}; choose another folder"
        ) from error
