"""Reconstructs every recording of a data set. What is finished is kept: a run that was killed goes on."""

import json
import shlex
import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import typer
from pydantic import BaseModel, ValidationError

from spiked.datasets import Clip, Dataset, DatasetKind, PictureScene
from spiked.errors import ConfigurationError, DatasetError, SpikedError
from spiked.recording import open_recording
from spiked.whole_files import FULL, write_atomically
from spiked_service.cli import outputs
from spiked_service.cli.commands.reconstruct import reconstruct
from spiked_service.cli.commands.simulate import simulate
from spiked_service.cli.dataset_runs.children import INTERRUPTED, run_spiked
from spiked_service.cli.dataset_runs.pictures import simulation_arguments
from spiked_service.cli.dataset_runs.scores import notes, score
from spiked_service.cli.dataset_runs.table import Row, Table, write_zip

_DONE = "done.json"
"""In the folder of a result: its row, written when all else is."""
_COMPLETE = "complete"
"""Outcome of a recording that was reconstructed."""
_USAGE = 2
"""Exit status for options or files that cannot be used."""


class _Begun(BaseModel):
    """What a run was begun with: a later run in the same folder must be the same."""

    dataset: str
    folder: str
    options: list[str]
    simulation: list[str]


class InterruptedRunError(SpikedError):
    """The run was interrupted; it goes on when it is started again."""


@dataclass
class DatasetRun:
    """A run of a data set into a folder."""

    kind: DatasetKind
    dataset: Dataset
    out: Path
    options: list[str]
    """For `spiked reconstruct`."""
    simulation: list[str]
    """For `spiked simulate`, of scenes of pictures."""
    keep_recordings: bool
    retry: bool
    """Reconstruct again what failed before."""
    show: Callable[[str], None]
    _rows: list[Row] = field(default_factory=list)

    def begin(self) -> None:
        """Check the options and claim the folder. Raises ConfigurationError where it is another run's."""
        outputs.try_folder("--out", self.out)
        check_options(reconstruct, ["recording.dat", "-o", "out", *self.options])
        if any(isinstance(item, PictureScene) for item in self.dataset.items):
            check_options(simulate, ["-o", "out", *self.simulation])
        begun = _Begun(
            dataset=self.kind.name,
            folder=str(self.dataset.folder.resolve()),
            options=self.options,
            simulation=self.simulation,
        )
        path = self.out / "run.json"
        if path.exists():
            try:
                before = _Begun.model_validate_json(path.read_bytes())
            except (OSError, ValidationError) as error:
                raise ConfigurationError(f"{path} cannot be read: name another folder with -o") from error
            if before != begun:
                raise ConfigurationError(
                    f"--out {self.out} holds a run of {before.dataset} in {before.folder} with the options "
                    f"{' '.join(before.options) or '(none)'}: give the same ones to go on, or name another folder"
                )
        with outputs.writing("--out", self.out):
            self.out.mkdir(parents=True, exist_ok=True)
            write_atomically(path, begun.model_dump_json(indent=1).encode())

    def carry_out(self) -> Table:
        """All recordings in turn, the table, and the zip. Raises InterruptedRunError and ConfigurationError."""
        items = self.dataset.items
        for left in (self.out / "recordings").glob("*.part*"):
            shutil.rmtree(left)  # of a run that was killed
        for number, item in enumerate(items, 1):
            folder = self.out / "results" / _folder_name(item.name)
            done = _finished(folder, self.dataset.of([item]).files)
            if done is not None and not (self.retry and done.outcome != _COMPLETE):
                self.show(f"[{number}/{len(items)}] {item.name}: finished before")
            else:
                self.show(f"[{number}/{len(items)}] {item.name}")
                done = self._one(item, folder)
            self._rows.append(done)
        return self._write()

    def _write(self) -> Table:
        said = ["--simulate", shlex.quote(shlex.join(self.simulation))] if self.simulation else []
        table = Table(self.kind, [*said, *self.options], self._rows)
        results = {_folder_name(row.name): self.out / "results" / _folder_name(row.name) for row in self._rows}
        with outputs.writing("--out", self.out):
            write_atomically(self.out / "table.md", table.markdown().encode())
            write_atomically(self.out / "table.csv", table.csv().encode())
            write_zip(self.out / f"{self.kind.name}.zip", table, results)
        return table

    def _one(self, item: Clip | PictureScene, result: Path) -> Row:
        with outputs.writing("--out", self.out):
            result.mkdir(parents=True, exist_ok=True)
        log = self.out / "results" / f"{result.name}.log"
        recording = None
        try:
            recording = self._recording(item, log)
        except (DatasetError, SpikedError) as error:
            full = isinstance(error.__cause__, OSError) and error.__cause__.errno in FULL
            if full or isinstance(error, InterruptedRunError | ConfigurationError):
                raise
            row = Row(name=item.name, outcome=f"no recording: {error}")
        else:
            row = self._reconstructed(item, recording, result, log)
        with outputs.writing("--out", self.out):
            write_atomically(result / _DONE, row.model_dump_json(indent=1).encode())
        if recording is not None and not self.keep_recordings and not (isinstance(item, Clip) and item.is_recording):
            going = recording.parent.with_name(f"{recording.parent.name}.part")  # half of it is none
            recording.parent.rename(going)
            shutil.rmtree(going)
        return row

    def _recording(self, item: Clip | PictureScene, log: Path) -> Path:
        """Make the recording, or find that of before."""
        name = _folder_name(item.name)
        place, part = self.out / "recordings" / name, self.out / "recordings" / f"{name}.part"
        if place.is_dir():
            return next(place.glob("*.dat"))
        with outputs.writing("--out", self.out):
            if isinstance(item, Clip):
                item.write(part, self.kind.name)
            else:
                self._simulate(item, part, log)
            part.rename(place)
        return next(place.glob("*.dat"))

    def _simulate(self, scene: PictureScene, part: Path, log: Path) -> None:
        pictures = part.with_name(f"{part.name}.pictures")
        arguments = simulation_arguments(scene, pictures, part, "simulated", self.simulation)
        status = self._run(arguments, log)
        if status != 0:
            raise DatasetError(f"spikes cannot be made of {scene.name}: {_last_error(log)}; see {log}")
        shutil.rmtree(pictures)

    def _reconstructed(self, item: Clip | PictureScene, recording: Path, result: Path, log: Path) -> Row:
        begin = time.monotonic()
        status = _USAGE
        if (result / "checkpoint").is_dir():
            status = self._run(["reconstruct", "--resume", str(result)], log)
        if status == _USAGE:
            status = self._run(["reconstruct", str(recording), "-o", str(result), *self.options], log)
        seconds = time.monotonic() - begin
        if status == _USAGE:
            raise ConfigurationError(f"{item.name}: {_last_error(log)}; see {log}")
        said = [*(item.notes if isinstance(item, Clip) else ()), *notes(recording)]
        frames = open_recording(recording).frames
        report = result / "report.json"
        if status != 0 or not report.is_file():
            return Row(
                name=item.name, outcome=_last_error(log) or "failed", figures={"frames": float(frames)}, notes=said
            )
        poses = sum(not line.startswith("#") for line in (result / "trajectory.tum").open(encoding="utf-8"))
        figures = {"frames": float(frames), "poses": float(poses), "seconds": seconds, **score(result, recording, log)}
        (result / "score.json").write_text(json.dumps(figures, indent=1), "utf-8")
        said += json.loads(report.read_text("utf-8")).get("warnings", [])
        return Row(name=item.name, outcome=_COMPLETE, figures=figures, notes=said)

    def _run(self, arguments: list[str], log: Path) -> int:
        status = run_spiked(arguments, log, lambda line: self.show(f"    {line}"))
        if status == INTERRUPTED or status < 0:
            how = "interrupted" if status == INTERRUPTED else f"`spiked {arguments[0]}` was ended by signal {-status}"
            raise InterruptedRunError(f"{how}; the same command goes on with what is left of {self.out}")
        return status


def check_options(command: Callable[..., None], arguments: list[str]) -> None:
    """End the program with the usage of a command for arguments that it does not take."""
    program = typer.Typer()
    program.command()(command)
    typer.main.get_command(program).make_context(f"spiked {command.__name__}", arguments)


def _folder_name(name: str) -> str:
    return name.replace("/", "__")


def _finished(folder: Path, files: Iterable[Path]) -> Row | None:
    """The row of before, unless a file has changed since."""
    path = folder / _DONE
    try:
        written = path.stat().st_mtime_ns
        if any(one.stat().st_mtime_ns > written for one in files):
            return None
        return Row.model_validate_json(path.read_bytes())
    except (OSError, ValidationError):
        return None


def _last_error(log: Path) -> str:
    lines = log.read_text("utf-8", "replace").splitlines()
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    return errors[-1] if errors else next((line for line in reversed(lines) if line.strip()), "")
