"""What the truth of a data set says of a result: poses and views where there are any."""

import json
from pathlib import Path

from spiked.errors import SpikedError
from spiked.evaluate import MATCH_FRAMES, pose_errors, score_trajectory
from spiked.recording import open_recording
from spiked.trajectory import Trajectory
from spiked_service.cli.dataset_runs.children import run_spiked

FEWEST_POSES = 3
"""Poses of a similarity that is determined; errors of fewer mean nothing."""


def score(result: Path, recording: Path, log: Path) -> dict[str, float]:
    """Figures of `spiked evaluate`; of few true poses the coverage and the ATE alone; none without truth.

    Without intrinsics in the recording no view can be rendered, and poses alone are scored.
    """
    if not (recording.parent / "groundtruth.tum").exists():
        return {}
    sensor = open_recording(recording).sensor
    figures: dict[str, float] = {}
    if sensor.intrinsics is not None:
        made = result / "score.json"
        made.unlink(missing_ok=True)
        arguments = ["evaluate", str(result), "--recording", str(recording), "--json", str(made)]
        if run_spiked(arguments, log, lambda line: None) == 0:
            figures = {name: value for name, value in json.loads(made.read_text()).items() if value is not None}
    if "ate_percent" not in figures:
        figures |= _pose_figures(result, recording, sensor.frame_rate_hz)
    return figures


def notes(recording: Path) -> list[str]:
    """What a reader of the scores of pictures has to know."""
    try:
        held_out = json.loads((recording.parent / "views.json").read_text("utf-8")).get("held_out", True)
    except OSError:
        return []
    return [] if held_out else ["scored on pictures that the spikes were made of: too far apart to leave some aside"]


def _pose_figures(result: Path, recording: Path, frame_rate_hz: float) -> dict[str, float]:
    truth = Trajectory.read_tum(recording.parent / "groundtruth.tum")
    try:
        estimate = Trajectory.read_tum(result / "trajectory.tum")
        full = score_trajectory(truth=truth, estimate=estimate, frame_rate_hz=frame_rate_hz)
        if full.errors is not None:
            return {"coverage": full.coverage, **vars(full.errors)}
        rows = estimate.nearest(truth.times_s, MATCH_FRAMES / frame_rate_hz)
        found = rows >= 0
        figures = {"coverage": float(found.mean())}
        if found.sum() < FEWEST_POSES:
            return figures
        errors = pose_errors(
            truth=(truth.rotations[found], truth.centres[found]),
            estimate=(estimate.rotations[rows[found]], estimate.centres[rows[found]]),
        )
    except SpikedError:
        return {}
    return {**figures, "ate_percent": errors.ate_percent, "ate_unit": errors.ate_unit}
