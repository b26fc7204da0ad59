"""Results on the way: what the checkpoint of a run that was killed has, as an output folder."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from pydantic import TypeAdapter

from spiked.errors import CheckpointError, SceneError
from spiked.recon.checkpoint import Interrupted
from spiked.recon.checkpoint_file import CHECKPOINT
from spiked.recording import RecordingGeometry, open_recording
from spiked_service.results.map_reports import REPORT, RUN, recording_section

_GEOMETRY = TypeAdapter(RecordingGeometry)


def is_of_interrupted_run(folder: Path) -> bool:
    """Whether the results in a folder with a checkpoint are of the run that it is of, and not of one before.

    They count as such beside a checkpoint that cannot be read. Raises SceneError.
    """
    try:
        document = json.loads((folder / REPORT).read_bytes())
    except FileNotFoundError:
        return False
    except (OSError, ValueError) as error:
        raise SceneError(f"{folder / REPORT} cannot be read: {error}") from error
    try:
        run = Interrupted.read(folder / CHECKPOINT).parameters.get(RUN)
    except CheckpointError:
        return True
    return isinstance(document, dict) and document.get(RUN) == run


@contextmanager
def results_on_the_way(folder: Path, recording: Path | None) -> Iterator[Path]:
    """A temporary folder with scene.ply, trajectory.tum and report.json; `recording` if it is not where it was.

    The checkpoint stays as it is. Raises CheckpointError, and RecordingError if the recording is gone.
    """
    interrupted = Interrupted.read(folder / CHECKPOINT)
    geometry = _GEOMETRY.validate_python(interrupted.parameters["geometry"])
    found = open_recording(recording or interrupted.recording, **geometry.stated())
    reconstructor = interrupted.resume(found)
    with TemporaryDirectory(prefix="spiked-report-") as name:
        made = Path(name)
        reconstructor.scene().write_ply(made / "scene.ply", reconstructor.white)
        reconstructor.trajectory().write_tum(made / "trajectory.tum")
        report = {**reconstructor.report(), "recording": recording_section(found)}
        (made / REPORT).write_text(json.dumps(report), encoding="utf-8")
        yield made
