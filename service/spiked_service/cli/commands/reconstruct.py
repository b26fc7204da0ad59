"""`spiked reconstruct`: reconstructs a recording; writes scene, trajectory, report and overview."""

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

from spiked.errors import ConfigurationError, SceneError, SpikedError
from spiked.numpy_files import UNREADABLE
from spiked.recon import (
    Initialisation,
    LossName,
    Merged,
    MethodName,
    NotOnePlaceError,
    Options,
    PoseStepName,
    Reconstructor,
    State,
    Status,
    extend,
)
from spiked.trajectory import Trajectory
from spiked_service.base.signals import handling
from spiked_service.cli import outputs
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import messages, output, report_error, report_warning
from spiked_service.cli.flag_groups import with_groups
from spiked_service.cli.maps import read_map
from spiked_service.cli.reconstruction_run import RESULTS, ReconstructionRun, parameters_of
from spiked_service.results.map_folder import MapFolder, file_name, joint_paths, replacing, write_map
from spiked_service.results.mosaic_by_pixels import by_pixels
from spiked_service.results.recording_feed import reconstruct_recording
from spiked_service.settings.map_options import changed
from spiked_service.settings.reconstruction_options import ReconstructionOptions

if TYPE_CHECKING:
    from spiked_service.cli.watch import Watch

INTERRUPTED = 130
"""Exit status after Ctrl-C: 128 + SIGINT, as in shells."""
_STDERR = 2
"""File descriptor: a signal handler must not use buffered output."""


_DEFAULTS = ReconstructionOptions()


def _option(name: str) -> Any:
    """A command-line option with limits and description of `ReconstructionOptions`."""
    described = ReconstructionOptions.model_fields[name]
    limits = {kind: getattr(part, kind) for part in described.metadata for kind in ("ge", "le") if hasattr(part, kind)}
    return typer.Option(help=described.description, min=limits.get("ge"), max=limits.get("le"))


MapOptionTexts = Annotated[
    list[str] | None,
    typer.Option(
        "--map-option",
        metavar="NAME=VALUE",
        help="A field of spiked.recon.MapOptions, for experiments: sub_frames=0, seeding.sure=0.5; repeatable. A wrong "
        "name lists all.",
    ),
]


@dataclass(frozen=True)
class ReconstructionFlags:
    """One flag for each option of a reconstruction."""

    steps: Annotated[int, _option("steps")] = _DEFAULTS.steps
    seed: Annotated[int, _option("seed")] = _DEFAULTS.seed
    window_frames: Annotated[int | None, _option("window_frames")] = _DEFAULTS.window_frames
    threads: Annotated[int | None, _option("threads")] = _DEFAULTS.threads
    max_views: Annotated[int, _option("max_views")] = _DEFAULTS.max_views
    most_splats: Annotated[int, _option("most_splats")] = _DEFAULTS.most_splats
    memory_mb: Annotated[int, _option("memory_mb")] = _DEFAULTS.memory_mb
    refine_poses: Annotated[bool, _option("refine_poses")] = _DEFAULTS.refine_poses
    method: Annotated[MethodName, _option("method")] = _DEFAULTS.method
    initialisation: Annotated[Initialisation | None, _option("initialisation")] = _DEFAULTS.initialisation
    pose_step: Annotated[PoseStepName | None, _option("pose_step")] = _DEFAULTS.pose_step
    loss: Annotated[LossName | None, _option("loss")] = _DEFAULTS.loss

    def options(self) -> Options:
        """Raises ConfigurationError."""
        return ReconstructionOptions(**vars(self)).options()


_SECONDS = typer.Option(help="Time budget: reduces the steps, and at last the frames that are read.", min=0.0)
_FIRST_DEPTH = typer.Option(
    help="With --method nope-sgs: depth of the first view as NumPy's .npy [H, W], in any unit, by any estimator; "
    "from a flat view that method does not find its path."
)


@with_groups
def reconstruct(
    context: typer.Context,
    file: Annotated[Path | None, typer.Argument(help="A recording.", readable=False)] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the results; created if missing.")] = None,
    resume: Annotated[
        Path | None,
        typer.Option(help="Folder of the results of an interrupted run: it goes on, with that run's options."),
    ] = None,
    map: Annotated[
        Path | None, typer.Option(help="Output folder of an earlier run, of the same place: its map is extended.")
    ] = None,
    poses: Annotated[Path | None, typer.Option(help="TUM file of known camera-to-world poses.")] = None,
    first_depth: Annotated[Path | None, _FIRST_DEPTH] = None,
    seconds: Annotated[float | None, _SECONDS] = None,
    *,
    chosen: ReconstructionFlags,
    map_option: MapOptionTexts = None,
    watch: Annotated[bool, typer.Option("--watch", help="Serve a progress page.")] = False,
    watch_port: Annotated[int, typer.Option(help="Port of the progress page; 0: any free port.", min=0)] = 8660,
    optics: g.OpticsFlags,
    geometry: g.DetectableGeometryFlags,
    profile: g.Profile = None,
    calibration: g.CalibrationFile = None,
) -> None:
    """Reconstruct the camera's trajectory and a Gaussian scene from a recording.

    Writes scene.ply (3DGS fields), trajectory.tum (a pose for every tracked frame), report.json and overview.png to
    OUT. Ctrl-C writes the current state and exits with code 130. If no path is found, the exit code is 1, report.json
    gives the reason, and overview.png shows the observed views.

    Every few seconds OUT/checkpoint takes what was done; it is removed at the end. After a kill, a power cut or Ctrl-C
    `--resume OUT` goes on from there, with the options of the interrupted run and the same result.

    With `--map` the recording is reconstructed and brought into the frame of reference of that map, and OUT has one map
    of both, with the path of each recording in OUT/paths. If the map does not show the same place, OUT has the
    reconstruction alone, and the exit code is 1.

    Examples:

    - `spiked reconstruct rec.dat -o out`

    - `spiked reconstruct tuesday.dat --map monday -o both`

    - `spiked reconstruct rec.dat -o out --fov 60 --seconds 120`

    - `spiked reconstruct rec.dat -o out --poses known.tum`

    - `spiked reconstruct rec.dat -o theirs --method nope-sgs --steps 6000`

    - `spiked reconstruct --resume out`
    """
    if resume is not None:
        run = ReconstructionRun.resumed(context, resume, file, out)
        _carry_out(run, _watched(run.recording.path.name, watch_port) if watch else None)
        return
    if file is None or out is None:
        raise ConfigurationError("name a recording and a folder for the results (-o OUT), or --resume OUT")
    outputs.try_folder("--out", out, RESULTS)
    run = _begun(context, file, out, chosen, optics, geometry)
    _carry_out(run, _watched(file.name, watch_port) if watch else None)


def _begun(
    context: typer.Context,
    file: Path,
    out: Path,
    chosen: ReconstructionFlags,
    optics: g.OpticsFlags,
    geometry: g.DetectableGeometryFlags,
) -> ReconstructionRun:
    """A new run, by the other parameters of the command, too. Raises SpikedError."""
    given = context.params
    if given["map"] is not None:
        _check_map(given["map"], out)
    described = g.open_described(file, geometry.stated(), given["profile"])
    recording = described.recording
    for warning in recording.warnings:
        report_warning(warning)
    sensor = optics.of(recording.sensor)
    questions = list(recording.questions)
    if geometry.detects:
        sensor, question = by_pixels(recording, sensor)
        if question is None:
            stated = "grey" if sensor.mosaic is None else sensor.mosaic
            messages.print(f"the pixels agree with the stated mosaic: {stated}", markup=False)
        else:
            questions.append(question)
    known = None if given["poses"] is None else Trajectory.read_tum(given["poses"])
    first_depth = None if given["first_depth"] is None else _read_depth(given["first_depth"])
    measured = g.read_calibration(given["calibration"], described)
    options = replace(chosen.options(), poses=known, calibration=measured, first_depth=first_depth)
    mapping = changed(options.mapping, given["map_option"] or [])
    reconstructor = Reconstructor(sensor, replace(options, mapping=mapping), recording=recording)
    reconstructor.warnings += questions
    return ReconstructionRun.begun(recording, reconstructor, out, parameters_of(context, described.geometry))


def _read_depth(file: Path) -> NDArray[np.float64]:
    """A depth map. Raises ConfigurationError."""
    try:
        depth = np.load(file, allow_pickle=False)
    except UNREADABLE as error:
        raise ConfigurationError(f"--first-depth {file}: {error}") from error
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise ConfigurationError(f"--first-depth {file}: expected one array of numbers [H, W]")
    return depth.astype(np.float64)


def _carry_out(run: ReconstructionRun, page: "Watch | None") -> None:
    """Reconstruct, write the results and report the outcome. Raises typer.Exit."""
    reconstructor = run.reconstructor
    known = None if run.map is None else MapFolder.read(run.map)
    interrupted = _run_through(run, page)
    joint: Merged | SpikedError | None = None
    if known is not None and not interrupted and reconstructor.failure is None:
        run.checkpoints.save(reconstructor, now=True)  # after a kill only the rest is repeated
        joint, interrupted = _extended(known, reconstructor)
    run.note_the_end(interrupted)
    if known is not None and isinstance(joint, Merged):
        _write_joint(run, known, joint)
    else:
        _write(run, {} if joint is None else {"map": str(run.map), "joined": False, "reason": str(joint)})
    _report(run)
    if known is not None and joint is not None:
        _report_joint(run, known, joint)
    if interrupted:
        run.checkpoints.close()
        raise typer.Exit(INTERRUPTED)
    run.checkpoints.remove()
    if reconstructor.failure is not None or isinstance(joint, SpikedError):
        raise typer.Exit(1)


def _check_map(folder: Path, out: Path) -> None:
    """Raises SceneError and ConfigurationError for a map that cannot be extended, before hours of work."""
    read_map(folder)
    if out.resolve() == folder.resolve():
        raise ConfigurationError(f"--out {out} is the map that is to be extended; name another folder")


def _extended(known: MapFolder, reconstructor: Reconstructor) -> tuple[Merged | SpikedError | None, bool]:
    """The map extended by the reconstruction, or why that cannot be; and whether it was interrupted."""
    with _interruptible() as interrupt, Progress(
        console=messages, transient=True, disable=not messages.is_terminal
    ) as bar:  # fmt: skip
        task = bar.add_task("extending", total=1.0)
        try:
            made = extend(known.known, reconstructor, lambda share: bar.update(task, completed=share), interrupt.is_set)
        except (NotOnePlaceError, SceneError) as error:
            return error, interrupt.is_set()
    return (None, True) if interrupt.is_set() else (made, False)


def _write_joint(run: ReconstructionRun, known: MapFolder, made: Merged) -> None:
    figures = {"map": str(run.map), "joined": True, "versions": known.versions, **made.report()}
    report = {**run.report(), "splats": len(made.scene), "extended": figures}
    with outputs.writing("--out", run.out):
        run.out.mkdir(parents=True, exist_ok=True)
        _draw(run, run.out)
        write_map(run.out, made.scene, made.joint.second.trajectory, _joint_paths(run, known, made), report)


def _joint_paths(run: ReconstructionRun, known: MapFolder, made: Merged) -> dict[str, Trajectory]:
    own = {file_name(run.out.resolve().name): run.reconstructor.trajectory()}
    return joint_paths(known.paths, own, made.joint.second.trajectory)


def _report_joint(run: ReconstructionRun, known: MapFolder, joint: Merged | SpikedError) -> None:
    if isinstance(joint, SpikedError):
        report_error(SpikedError(f"{run.map} was not extended: {joint}; {run.out} has the reconstruction alone"))
        return
    output.print(
        f"{run.out}: {len(joint.scene)} splats with those of {run.map}, "
        f"paths {', '.join(_joint_paths(run, known, joint))}; "
        f"{len(joint.joint.registration.sightings)} views agree with it",
        markup=False,
    )


def _run_through(run: ReconstructionRun, page: "Watch | None") -> bool:
    """Feed and refine with a progress display. Return whether it was interrupted."""
    recording, reconstructor = run.recording, run.reconstructor
    with _interruptible() as interrupt, ProgressDisplay(run.frames) as display:
        saved = False

        def show(status: Status) -> None:
            display.show(status)
            if page is not None:
                page.show(reconstructor, status)

        def save() -> None:
            nonlocal saved
            if not saved:  # after Ctrl-C the rest is cut short
                saved = interrupt.is_set()
                run.checkpoints.save(reconstructor, now=saved)

        reconstruct_recording(
            recording, reconstructor, progress=show, cancelled=interrupt.is_set, budget_s=run.budget_s, save=save
        )
    if page is not None:
        page.close()
    return interrupt.is_set()


def _report(run: ReconstructionRun) -> None:
    """Print the warnings and the outcome."""
    reconstructor = run.reconstructor
    for warning in reconstructor.warnings:
        report_warning(warning)
    status, failure = reconstructor.status(), reconstructor.failure
    reason = "" if status.state is State.TRACK else f": {status.reason}"
    outcome = f"{status.splats} splats, {status.state}{reason}" if failure is None else "failed"
    poses = len(reconstructor.trajectory())
    read = f"{status.frames}" if status.frames >= run.frames else f"the first {status.frames} of {run.frames}"
    output.print(f"{run.out}: {poses} poses for {read} frames, {outcome}", markup=False)
    if failure is not None:
        report_error(SpikedError(f"no path was found: {failure}"))


def _watched(title: str, port: int) -> "Watch":
    from spiked_service.cli.watch import Watch  # imports a web server

    page = Watch(title, port)
    messages.print(f"progress page: {page.url}", markup=False)
    return page


class _Interrupt:
    """Set by the first Ctrl-C or SIGTERM; a second one ends the program."""

    def __init__(self) -> None:
        self._set = False

    def is_set(self) -> bool:
        return self._set

    def handle(self, number: int, frame: FrameType | None) -> None:
        if self._set:
            raise KeyboardInterrupt
        self._set = True
        # Not through Python's buffers: the signal may interrupt a write to them.
        os.write(_STDERR, b"stopping; writing what there is (Ctrl-C again to leave at once)\n")


@contextmanager
def _interruptible() -> Iterator[_Interrupt]:
    interrupt = _Interrupt()
    with handling(dict.fromkeys((signal.SIGINT, signal.SIGTERM), interrupt.handle)):
        yield interrupt


class ProgressDisplay:
    """Two live lines: stage, bar and time left; frames, state, loss, splats.

    Without a terminal, a plain line every 5 s and at each change of stage.
    """

    def __init__(self, frames: int, console: Console = messages) -> None:
        self._frames = frames
        self._console = console
        self._bar = Progress(
            TextColumn("{task.description:9s}"),
            BarColumn(bar_width=28),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=console,
        )
        self._task = self._bar.add_task("waiting", total=1.0, left="")
        self._figures = Text()
        self._live = Live(Group(self._bar, self._figures), console=console)
        self._begun = self._last = time.monotonic()
        self._stage = ""
        self._done = 0.0

    def __enter__(self) -> "ProgressDisplay":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def show(self, status: Status) -> None:
        """Show the status."""
        loss = "" if status.loss is None else f"  loss {status.loss:.2e}"
        figures = f"{status.frames}/{self._frames} frames  {status.state}{loss}  {status.splats} splats"
        left = "" if status.left_s is None else f"{_duration(status.left_s)} left"
        self._done = 1.0 if status.stage == "done" else max(self._done, self._share(status.left_s))
        self._bar.update(self._task, description=status.stage, completed=self._done, left=left)
        self._figures.plain = figures
        if not self._console.is_terminal and (status.stage != self._stage or time.monotonic() - self._last > 5):
            self._last, self._stage = time.monotonic(), status.stage
            refined = f"{100 * status.progress:.0f} % refined"
            self._console.print(f"{status.stage}: {figures}  {refined}{left and f', {left}'}", markup=False)

    def _share(self, left_s: float | None) -> float:
        """Share of the time that has passed; 0 while that is not known."""
        passed_s = time.monotonic() - self._begun
        return 0.0 if left_s is None else passed_s / max(passed_s + left_s, 1e-9)


def _duration(seconds: float) -> str:
    """A time left in words, no finer than it is known."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, hours = round(seconds / 60), int(seconds / 3600)
    return f"{minutes} min" if minutes < 60 else f"{hours} h {round((seconds - 3600 * hours) / 60)} min"


def _write(run: ReconstructionRun, extended: dict[str, object]) -> None:
    """Write the reconstruction alone; `extended` says why the map is not in it, if there is one."""
    reconstructor, out = run.reconstructor, run.out
    report = {**run.report(), **({"extended": extended} if extended else {})}
    with outputs.writing("--out", out), replacing(out) as making:
        reconstructor.scene().write_ply(making / "scene.ply", reconstructor.white)
        reconstructor.trajectory().write_tum(making / "trajectory.tum")
        (making / "report.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
        _draw(run, making)


def _draw(run: ReconstructionRun, folder: Path) -> None:
    from spiked_service.cli.overview import draw_overview  # matplotlib takes longer to load than most commands run

    reconstructor = run.reconstructor
    draw_overview(reconstructor, run.recording.path.name, reconstructor.losses, folder / "overview.png")
