"""`spiked evaluate`: errors of a reconstruction against ground truth."""

import json
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from pydantic import BaseModel

from spiked.errors import SceneError
from spiked.evaluate import ViewScore, score_trajectory, score_views, similarity_of_trajectories
from spiked.recording import Recording, open_recording
from spiked.render import Camera
from spiked.render.cpu import Rasteriser
from spiked.scene import Scene
from spiked.trajectory import Trajectory
from spiked_service.cli import outputs
from spiked_service.cli.console import output

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)  # the weights by which the truth's grey pictures were made


def evaluate(
    result: Annotated[Path, typer.Argument(help="Output folder of `spiked reconstruct`.")],
    recording: Annotated[Path, typer.Option(help="The recording, with groundtruth.tum and views.json beside it.")],
    json_out: Annotated[Path | None, typer.Option("--json", help="Also write the figures to this file.")] = None,
) -> None:
    """Print coverage, ATE and RPE of a trajectory, and PSNR and SSIM of held-out views: the mean, and the worst PSNR.

    Held-out views have no distortion. Of a simulated lens with distortion, `lens_` figures compare the same poses in
    the lens's own pixels: what the undistorted figures lose against them is resolution that the lens did not have.

    ATE is in percent of the RMS radius of the true path, after alignment by a similarity. RPE is over 32 frames.

    Example: `spiked simulate -o room && spiked reconstruct room/simulated.dat -o out &&
    spiked evaluate out --recording room/simulated.dat`
    """
    if json_out is not None:
        outputs.try_file("--json", json_out)
    source = open_recording(recording)
    rate_hz = source.sensor.frame_rate_hz
    truth = Trajectory.read_tum(recording.parent / "groundtruth.tum")
    estimate = Trajectory.read_tum(result / "trajectory.tum")
    score = score_trajectory(truth=truth, estimate=estimate, frame_rate_hz=rate_hz)
    figures: dict[str, float] = {"coverage": score.coverage}
    if score.errors is not None:
        figures |= vars(score.errors)
        scene = Scene.read_ply(result / "scene.ply")
        for prefix, through_lens in (("", False), ("lens_", True)):
            views = _score_views(source, truth, estimate, scene, through_lens=through_lens)
            if views is not None:
                figures[f"{prefix}psnr_db"] = views.mean_psnr_db
                figures[f"{prefix}worst_psnr_db"] = min(views.psnr_db)
                figures[f"{prefix}ssim"] = views.mean_ssim
    for name, value in figures.items():
        output.print(f"{name:18s} {value:.4f}")
    if json_out is not None:
        with outputs.writing("--json", json_out):
            json_out.write_text(json.dumps(figures, indent=1), encoding="utf-8")


def _score_views(
    recording: Recording, truth: Trajectory, estimate: Trajectory, scene: Scene, *, through_lens: bool
) -> ViewScore | None:
    """The held-out views, with their true poses in the frame of the estimate; None if there are none."""
    sensor, folder = recording.sensor, recording.path.parent
    if sensor.intrinsics is None:
        raise SceneError(f"{recording.path} has no intrinsics in its sidecar, so its views cannot be rendered")
    held_out = _read_views(folder / "views.json")
    files = [view.lens_file if through_lens else view.file for view in held_out.views]
    if not files or None in files:
        return None
    similarity = similarity_of_trajectories(truth=truth, estimate=estimate, frame_rate_hz=sensor.frame_rate_hz)
    matrices = [np.array(view.c2w) for view in held_out.views]
    poses = [similarity.poses(matrix[:3, :3], matrix[:3, 3]) for matrix in matrices]
    pictures = [_read_picture(folder / file, colour=sensor.mosaic is not None) for file in files if file is not None]
    optics = sensor.intrinsics if through_lens else sensor.intrinsics.pinhole
    rasteriser = Rasteriser(Camera(optics, sensor.width, sensor.height))

    def render(rotation: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float32]:
        values = rasteriser.forward(scene, rotation[None], centre[None]).values
        return values @ _LUMINANCE if values.ndim == 3 and sensor.mosaic is None else values

    return score_views(render, poses=poses, truths=pictures, length=similarity.scale * held_out.median_depth)


class _View(BaseModel):
    file: str
    lens_file: str | None = None
    c2w: list[list[float]]


class _Views(BaseModel):
    median_depth: float
    views: list[_View]


def _read_views(path: Path) -> _Views:
    try:
        return _Views.model_validate_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise SceneError(f"cannot read the held-out views {path}: {error}") from error


def _read_picture(path: Path, *, colour: bool) -> NDArray[np.float32]:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB if colour else cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise SceneError(f"cannot read the held-out view {path}")
    return np.asarray(picture, np.float32) / np.float32(255)
