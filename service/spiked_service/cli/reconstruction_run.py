"""A run of `spiked reconstruct` that can be resumed: its checkpoints, and the options it was begun with."""

import uuid
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import typer
from pydantic import TypeAdapter

from spiked.errors import ConfigurationError
from spiked.recon import Reconstructor
from spiked.recon.checkpoint import CheckpointSaver, Interrupted
from spiked.recon.checkpoint_file import CHECKPOINT, exists
from spiked.recording import Recording, RecordingGeometry, open_recording
from spiked_service.cli import outputs
from spiked_service.cli.console import messages, report_warning
from spiked_service.results.map_reports import RUN, recording_section

RESULTS = "scene.ply", "trajectory.tum", "report.json", "overview.png"
"""Files in OUT."""
_NOT_STORED = "file", "out", "resume", "watch", "watch_port"
"""Parameters that a resumed run may have otherwise."""
_GEOMETRY = TypeAdapter(RecordingGeometry)


@dataclass
class ReconstructionRun:
    """A reconstruction of a recording, begun or resumed."""

    recording: Recording
    reconstructor: Reconstructor
    out: Path
    checkpoints: CheckpointSaver
    id: str
    """What tells it from other runs in the same folder."""
    budget_s: float | None
    map: Path | None = None
    """Folder of the map that is extended."""
    _outcome: str | None = None
    """Other than that of the reconstructor."""

    @property
    def frames(self) -> int:
        """Frames of the recording, lost ones included."""
        return self.recording.capture_index(self.recording.frames - 1) + 1

    def note_the_end(self, interrupted: bool) -> None:
        """Warn of results that are not those of the whole run."""
        made = self.reconstructor
        if interrupted:
            self._outcome = "interrupted"
            made.warnings.append(
                f"interrupted after {made.frames:,} of {self.frames:,} frames and {made.trainer.mapper.steps:,} steps "
                "of the map: these are results on the way"
            )
        elif made.frames < self.frames:
            self._outcome = "cut short"
            made.warnings.append(
                f"the time was over after {made.frames:,} of {self.frames:,} frames, and the others are left out: "
                "raise --seconds"
            )

    def report(self) -> dict[str, object]:
        """The content of report.json: the reconstructor's, and where the recording is and how it was read."""
        made = self.reconstructor.report()
        if made["outcome"] == "complete" and self._outcome is not None:
            made["outcome"] = self._outcome
        return {**made, "recording": recording_section(self.recording), RUN: self.id}

    @classmethod
    def begun(
        cls, recording: Recording, reconstructor: Reconstructor, out: Path, parameters: dict[str, Any]
    ) -> "ReconstructionRun":
        """A new run: a checkpoint of an earlier one in `out` is removed."""
        folder = out / CHECKPOINT
        parameters = {**parameters, RUN: uuid.uuid4().hex}
        saver = CheckpointSaver(folder, recording, parameters, report_warning)
        if exists(folder):
            report_warning(f"{out} held the checkpoint of an interrupted run; this run begins anew and replaces it")
            saver.remove()
        return cls(recording, reconstructor, out, saver, parameters[RUN], parameters["seconds"], _map_of(parameters))

    @classmethod
    def resumed(cls, context: typer.Context, folder: Path, file: Path | None, out: Path | None) -> "ReconstructionRun":
        """The run that was interrupted in a folder. Raises CheckpointError, RecordingError and ConfigurationError."""
        if out is not None and out.absolute() != folder.absolute():
            raise ConfigurationError(f"--resume {folder} writes its results there: leave out --out {out}")
        if not exists(folder / CHECKPOINT):
            ended = (folder / "report.json").exists()
            why = "the run there is over" if ended else "no run was interrupted there after its first seconds"
            raise ConfigurationError(
                f"--resume {folder} has no checkpoint: {why}; to reconstruct anew leave out --resume"
            )
        interrupted = Interrupted.read(folder / CHECKPOINT)
        parameters = interrupted.parameters
        _check_options(context, parameters)
        geometry = _GEOMETRY.validate_python(parameters["geometry"])
        recording = open_recording(file or interrupted.recording, **geometry.stated())
        saver = CheckpointSaver(folder / CHECKPOINT, recording, parameters, report_warning)
        interrupted = Interrupted.read(folder / CHECKPOINT)  # again: nobody writes it now
        reconstructor = interrupted.resume(recording)
        outputs.try_folder("--resume", folder, RESULTS)
        messages.print(f"resumed: {interrupted.stage}", markup=False)
        budget_s = parameters["seconds"]
        left_s = None if budget_s is None else max(0.0, budget_s - reconstructor.work_s)
        return cls(recording, reconstructor, folder, saver, parameters.get(RUN, ""), left_s, _map_of(parameters))


def parameters_of(context: typer.Context, geometry: RecordingGeometry) -> dict[str, Any]:
    """All options of this run, ready for JSON."""
    options = {name: _plain(value) for name, value in context.params.items() if name not in _NOT_STORED}
    return options | {"geometry": _GEOMETRY.dump_python(geometry, mode="json")}


def _map_of(parameters: dict[str, Any]) -> Path | None:
    return None if parameters.get("map") is None else Path(parameters["map"])


def _check_options(context: typer.Context, parameters: dict[str, Any]) -> None:
    """Raises ConfigurationError where an option on the command line differs from that of the interrupted run."""
    for name in context.params.keys() & parameters.keys():
        source = context.get_parameter_source(name)
        given = source is not None and source.name == "COMMANDLINE"
        value, before = _plain(context.params[name]), parameters[name]
        if given and value != before:
            option = f"--{name.replace('_', '-')}"
            said = f"with {before}" if before is not None else "without it"
            raise ConfigurationError(
                f"{option} {value}: the interrupted run was begun {said}; leave {option} out, or begin anew without "
                "--resume"
            )


def _plain(value: Any) -> Any:
    """An option's value as JSON has it."""
    if isinstance(value, Path):
        return str(value.absolute())
    return value.value if isinstance(value, Enum) else value
