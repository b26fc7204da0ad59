"""`spiked evaluate`: a reconstruction against a recording's truth."""

import json
from pathlib import Path
from typing import Annotated

import typer

from spiked.errors import SceneError
from spiked.evaluate import score_trajectory
from spiked.trajectory import Trajectory
from spiked_service.console import output


def evaluate(
    trajectory: Annotated[Path, typer.Argument(help="The estimate, a TUM file.")],
    truth: Annotated[Path, typer.Option(help="The truth, a TUM file with a pose for every frame.")],
    rate: Annotated[float, typer.Option(help="Frames a second, by which time stamps are matched.")] = 20_000.0,
    json_out: Annotated[Path | None, typer.Option("--json", help="Write the figures here too.")] = None,
) -> None:
    """Print coverage, ATE and RPE of a trajectory.

    ATE is in percent of the RMS radius of the true path after alignment by a similarity; RPE is over 32 frames.

    Example: `spiked evaluate out/trajectory.tum --truth room/groundtruth.tum`
    """
    score = score_trajectory(Trajectory.read_tum(truth), Trajectory.read_tum(trajectory), rate)
    figures: dict[str, float] = {"coverage": score.coverage}
    if score.errors is not None:
        figures |= vars(score.errors)
    for name, value in figures.items():
        output.print(f"{name:14s} {value:.4f}")
    if json_out is not None:
        try:
            json_out.write_text(json.dumps(figures, indent=1), encoding="utf-8")
        except OSError as error:
            raise SceneError(f"cannot write {json_out}: {error.strerror}") from error
