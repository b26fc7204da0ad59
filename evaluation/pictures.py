"""Draw what a camera observed beside what its reconstruction renders from the same pose, a row for each stream.

    .venv/bin/python evaluation/pictures.py OUT.png RECORDING.dat RESULT_DIR [RECORDING.dat RESULT_DIR ...]

RESULT_DIR is what `spiked reconstruct RECORDING.dat -o RESULT_DIR` wrote. The observed picture is the mean of plain
frames about the middle of the recording, as a person would look at it; the render is of scene.ply at that pose.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from spiked.recon.frontend.demosaic import fill_mosaic
from spiked.recon.frontend.windowing import Windows
from spiked.recording import open_recording
from spiked.render import Camera, Rasteriser
from spiked.scene import Scene
from spiked.sensor import Image
from spiked.trajectory import Trajectory

WINDOW_FRAMES = 16


def pair(recording_path: Path, result: Path) -> tuple[Image, Image]:
    """Observed and rendered, [H, W, C] with white 1."""
    recording = open_recording(recording_path)
    sensor = recording.sensor
    assert sensor.intrinsics is not None, f"{recording_path} does not know its focal length"
    begin = recording.frames // 2 - WINDOW_FRAMES // 2
    first = max(0, begin - 32)
    frames = recording.read(first, min(recording.frames - first, WINDOW_FRAMES + 64))
    windows = Windows(sensor, WINDOW_FRAMES)
    views = [*windows.feed(first, frames), *windows.flush()]
    view = min(views, key=lambda v: abs(v.time - recording.frames / 2))
    channels = None if sensor.mosaic is None else sensor.mosaic.channels(sensor.height, sensor.width)
    observed = fill_mosaic(view.rate, channels)
    path = Trajectory.read_tum(result / "trajectory.tum")
    row = int(np.argmin(np.abs(path.times_s * sensor.frame_rate_hz - view.time)))
    scene = Scene.read_ply(result / "scene.ply")
    camera = Camera(sensor.intrinsics, sensor.width, sensor.height)
    rendered = Rasteriser(camera).forward(scene, path.rotations[row : row + 1], path.centres[row : row + 1]).values
    rendered = rendered[..., None] if rendered.ndim == 2 else rendered
    rendered = rendered[..., : observed.shape[2]]
    white = float(np.percentile(observed, 99.5))
    # The file is in units of white; one factor brings it to the observed brightness.
    factor = float((rendered * observed).sum() / (rendered * rendered).sum())
    return np.clip(observed / white, 0, 1), np.clip(rendered * factor / white, 0, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("files", type=Path, nargs="+", metavar="RECORDING RESULT_DIR")
    options = parser.parse_args()
    if len(options.files) % 2:
        parser.error("give a result folder for each recording")
    rows = [(a, pair(a, b)) for a, b in zip(options.files[::2], options.files[1::2], strict=True)]
    heights = [picture.shape[0] / picture.shape[1] for _, (picture, _) in rows]
    figure = Figure(figsize=(11, 5.5 * sum(heights) + 0.3 * len(rows)), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(rows), 2, squeeze=False, height_ratios=heights)
    for axes, (path, pictures) in zip(grid, rows, strict=True):
        for one, name, picture in zip(axes, ("observed, 16 frames", "rendered"), pictures, strict=True):
            one.imshow(picture[..., 0] if picture.shape[2] == 1 else picture, cmap="gray", vmin=0, vmax=1)
            one.set_title(f"{path.stem}: {name}", fontsize=9)
            one.set_xticks([])
            one.set_yticks([])
    figure.savefig(options.out, dpi=110)


if __name__ == "__main__":
    main()
