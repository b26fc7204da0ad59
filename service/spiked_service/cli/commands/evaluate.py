"""`spiked evaluate`: errors of a reconstruction against ground truth."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from pydantic import BaseModel

from spiked.errors import SceneError
from spiked.evaluate import ViewScore, score_trajectory, score_views, similarity_of_trajectories
from spiked.lpips import LPIPS_LEAST_SIDE_PX, LPIPS_NETWORK, Lpips, lpips_available
from spiked.recording import Recording, open_recording
from spiked.render import Camera
from spiked.render.cpu import Rasteriser
from spiked.scene import Scene
from spiked.trajectory import Trajectory
from spiked.whole_files import whole_folder, write_atomically
from spiked_service.cli import outputs
from spiked_service.cli.console import output, report_warning

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)  # the weights by which the truth's grey pictures were made


def evaluate(
    result: Annotated[Path, typer.Argument(help="Output folder of `spiked reconstruct` or `spiked baseline`.")],
    recording: Annotated[Path, typer.Option(help="The recording, with groundtruth.tum and views.json beside it.")],
    json_out: Annotated[Path | None, typer.Option("--json", help="Also write the figures to this file.")] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Also write the held-out views, true and rendered, to this folder.")
    ] = None,
    lpips: Annotated[
        bool | None,
        typer.Option(
            "--lpips/--no-lpips",
            help="LPIPS of the views; by default if it is installed and they are 63 pixels wide and high.",
        ),
    ] = None,
) -> None:
    """Print the errors of a trajectory, and of held-out views: the mean, and the worst PSNR.

    coverage: share of the true frames with a pose. ate_percent: ATE in percent of the RMS radius of the true path,
    after alignment by a similarity. rpe_r_deg and rpe_t_percent: over 32 frames, translation in percent of the radius.
    ate_unit, rpe_r_unit_deg and rpe_t_unit: the same of 24 poses on paths of unit norm, from each to the next and
    translation in hundredths, as the tables of CF-3DGS and InstantSplat have them. psnr_db, ssim and lpips: values in
    [0, 1], each pose refined with the scene held; LPIPS (extra `spiked[lpips]`) by AlexNet, smaller is better. A result
    without scene.ply has only the first of these.

    Held-out views have no distortion. Of a simulated lens with distortion, `lens_` figures compare the same poses in
    the lens's own pixels: what the undistorted figures lose against them is resolution that the lens did not have.

    Example: `spiked simulate -o room && spiked reconstruct room/simulated.dat -o out &&
    spiked evaluate out --recording room/simulated.dat`
    """
    if json_out is not None:
        outputs.try_file("--json", json_out)
    if pictures is not None:
        outputs.try_folder("--pictures", pictures)
    source = open_recording(recording)
    fits = min(source.sensor.width, source.sensor.height) >= LPIPS_LEAST_SIDE_PX
    perceptual = Lpips.load() if (lpips_available() and fits if lpips is None else lpips) else None
    truth = Trajectory.read_tum(recording.parent / "groundtruth.tum")
    estimate = Trajectory.read_tum(result / "trajectory.tum")
    score = score_trajectory(truth=truth, estimate=estimate, frame_rate_hz=source.sensor.frame_rate_hz)
    figures: dict[str, float] = {"coverage": score.coverage}
    if score.errors is not None:
        figures |= vars(score.errors)
        if (result / "scene.ply").exists():
            scene = Scene.read_ply(result / "scene.ply")
            for prefix, through_lens in (("", False), ("lens_", True)):
                views = _score_views(source, (truth, estimate), scene, perceptual, through_lens=through_lens)
                if views is None:
                    continue
                figures |= {prefix + name: value for name, value in _figures(views.score).items()}
                if pictures is not None and not through_lens:
                    _write_pictures(pictures, views)
    for name, value in figures.items():
        output.print(f"{name:18s} {value:.4f}" + (f"   by {LPIPS_NETWORK}" if name == "lpips" else ""))
    if json_out is not None:
        with outputs.writing("--json", json_out):
            write_atomically(json_out, json.dumps(figures, indent=1).encode())


@dataclass(frozen=True)
class _Scored:
    names: list[str]
    truths: list[NDArray[np.float32]]
    score: ViewScore


def _figures(views: ViewScore) -> dict[str, float]:
    figures = {"psnr_db": views.mean_psnr_db, "worst_psnr_db": min(views.psnr_db), "ssim": views.mean_ssim}
    return figures if views.mean_lpips is None else {**figures, "lpips": views.mean_lpips}


def _score_views(
    recording: Recording,
    paths: tuple[Trajectory, Trajectory],
    scene: Scene,
    perceptual: Lpips | None,
    *,
    through_lens: bool,
) -> _Scored | None:
    """The held-out views, with their true poses in the frame of the estimate; None if there are none.

    `paths` are the true one and the estimate.
    """
    sensor, folder = recording.sensor, recording.path.parent
    if sensor.intrinsics is None:
        raise SceneError(f"{recording.path} has no intrinsics in its sidecar, so its views cannot be rendered")
    held_out = _read_views(folder / "views.json")
    files = [view.lens_file if through_lens else view.file for view in held_out.views]
    if not files or None in files:
        return None
    if not held_out.held_out and not through_lens:
        report_warning(
            "the recording was made of the scored pictures, too: PSNR, SSIM and LPIPS say how well they are "
            "reproduced, not how good views between them are"
        )
    similarity = similarity_of_trajectories(truth=paths[0], estimate=paths[1], frame_rate_hz=sensor.frame_rate_hz)
    matrices = [np.array(view.c2w) for view in held_out.views]
    poses = [similarity.poses(matrix[:3, :3], matrix[:3, 3]) for matrix in matrices]
    truths = [_read_picture(folder / file, colour=sensor.mosaic is not None) for file in files if file is not None]
    optics = sensor.intrinsics if through_lens else sensor.intrinsics.pinhole
    rasteriser = Rasteriser(Camera(optics, sensor.width, sensor.height))

    def render(rotation: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float32]:
        values = rasteriser.forward(scene, rotation[None], centre[None]).values
        return values @ _LUMINANCE if values.ndim == 3 and sensor.mosaic is None else values

    length = similarity.scale * held_out.median_depth
    score = score_views(render, poses=poses, truths=truths, length=length, perceptual=perceptual)
    return _Scored([Path(view.file).stem for view in held_out.views], truths, score)


def _write_pictures(folder: Path, views: _Scored) -> None:
    """NAME-truth.png and NAME-render.png of each view."""
    with outputs.writing("--pictures", folder), whole_folder(folder, stale=("*-truth.png", "*-render.png")) as making:
        for name, truth, render in zip(views.names, views.truths, views.score.shown, strict=True):
            for kind, picture in (("truth", truth), ("render", render)):
                levels = np.rint(255 * picture).astype(np.uint8)
                shown = cv2.imencode(".png", levels if levels.ndim == 2 else levels[..., ::-1])[1]
                (making / f"{name}-{kind}.png").write_bytes(shown.tobytes())


class _View(BaseModel):
    file: str
    lens_file: str | None = None
    c2w: list[list[float]]


class _Views(BaseModel):
    median_depth: float
    views: list[_View]
    held_out: bool = True
    """False: the recording was made of these pictures, too."""


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
