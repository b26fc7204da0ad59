"""SpikeGS: streams of a colour spike camera, with images made of them and poses.

The authors' loader reads images and poses; the streams themselves were not published when this was written. As far as
known there is a `.dat` beside the images, and the number in an image's name is that of its frame.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from spiked.datasets import colmap, transforms
from spiked.datasets.clip import Clip, PictureScene, TrueView, Truth
from spiked.datasets.colmap_model import find_model
from spiked.datasets.kind import UNKNOWN, DatasetKind
from spiked.datasets.spikes import files_in, recorded_clip
from spiked.errors import DatasetError
from spiked.natural_order import natural
from spiked.recording import RecordingGeometry
from spiked.recording.geometry import DEFAULT_RATE_HZ
from spiked.sensor import Mosaic
from spiked.transforms import Transforms

WIRE_FRAME_BYTES, COMPACT_FRAME_BYTES = 128_000, 125_000
"""Bytes of a frame of the 1000x1000 camera, as its card delivers it, and without line numbers."""
GREY_SIZE = (400, 250)
"""The camera of this size is grey; others of the authors have a mosaic."""
_SPLITS = ("transforms_train.json", "transforms_test.json", "transforms_TFP.json")
_CITATION = (
    "Y. Guo, L. Hu, Y. Bai, J. Yao, L. Ma and T. Huang, SpikeGS: Reconstruct 3D scene captured by a fast-moving "
    "bio-inspired camera, arXiv:2407.03771"
)


def _scenes(folder: Path, has: str) -> list[Path]:
    """Folders with a `.dat` and this file or folder: the folder itself, or those in it."""
    for candidates in ([folder], sorted((p for p in folder.iterdir() if p.is_dir()), key=natural)):
        found = [scene for scene in candidates if (scene / has).exists() and files_in(scene, ".dat")]
        if found:
            return found
    return []


def recognises_real(folder: Path) -> bool:
    """Whether there is a stream beside a COLMAP model."""
    return bool(_scenes(folder, "sparse"))


def recognises_synthetic(folder: Path) -> bool:
    """Whether there is a stream beside poses in Blender's form."""
    return bool(_scenes(folder, _SPLITS[0]))


def read_real(folder: Path) -> tuple[Clip, ...]:
    """A clip for each scene. Raises SpikedError."""
    found = []
    for scene in _scenes(folder, "sparse"):
        if find_model(scene) is None:
            raise DatasetError(f"{scene / 'sparse'} has no COLMAP model; copy the scene anew")
        found.append(_clip(folder, scene, colmap.read_scene(scene.name, scene), frozenset()))
    return tuple(found)


def read_synthetic(folder: Path) -> tuple[Clip, ...]:
    """A clip for each scene; the pictures of `transforms_test.json` are held-out views. Raises SpikedError."""
    found = []
    for scene in _scenes(folder, _SPLITS[0]):
        pictures = transforms.read_scene(scene.name, scene)
        test = scene / _SPLITS[1]
        held_out = frozenset(
            Path(frame.file_path).stem for frame in Transforms.read(test).frames
        ) if test.is_file() else frozenset()  # fmt: skip
        found.append(_clip(folder, scene, pictures, held_out))
    return tuple(found)


def _clip(folder: Path, scene: Path, pictures: PictureScene, held_out: frozenset[str]) -> Clip:
    files = files_in(scene, ".dat")
    if len(files) > 1:
        raise DatasetError(f"{scene} has {len(files)} .dat files and one set of poses; leave one in it")
    size = (pictures.width, pictures.height)
    bytes_ = files[0].stat().st_size
    if size == (1000, 1000) and bytes_ % COMPACT_FRAME_BYTES and bytes_ % WIRE_FRAME_BYTES == 0:
        raise DatasetError(f"{files[0]} has the raw bytes of the card; write it anew: spiked convert --from pcie")
    numbers = np.array([_number(path) for path in pictures.pictures])
    order = np.argsort(numbers, kind="stable")
    times = (numbers[order] + 0.5) / DEFAULT_RATE_HZ
    if len(np.unique(numbers)) < len(numbers):
        raise DatasetError(f"{scene}: two pictures have the same number, so their frames are unknown; rename them")
    path = pictures.trajectory(1.0)
    poses = path.matrices()[order]
    views = [
        TrueView(pictures.pictures[k], float(time), pose)
        for k, time, pose in zip(order, times, poses, strict=True)
        if pictures.pictures[k].stem in held_out
    ]
    truth = Truth(type(path)(times, path.rotations[order], path.centres[order]), tuple(views), pictures.median_depth)
    given = RecordingGeometry(
        *size,
        flipped=True,
        mosaic=None if size == GREY_SIZE else Mosaic.BGGR,
        intrinsics=pictures.intrinsics,
    )
    clip = replace(recorded_clip(folder, files[0], given, truth), described_by=pictures.described_by)
    if times[-1] > clip.sensor.seconds(clip.frames):
        raise DatasetError(
            f"{files[0]} has {clip.frames} frames, and the last picture is of frame {numbers.max()}: the file is cut, "
            "or is not the stream of these pictures"
        )
    return clip


def _number(path: Path) -> int:
    found = re.findall(r"\d+", path.stem)
    if not found:
        raise DatasetError(f"{path}: its name has no number, so its frame is unknown; name pictures by their frames")
    return int(found[-1])


_SHARED = "SCENE/*.dat: one stream, LSB first, rows bottom-up, BGGR if it is not 400x250, as far as known"

REAL = DatasetKind(
    name="spikegs-real",
    title="SpikeGS, real scenes",
    sensor="colour (BGGR as read bottom-up), 1000x1000 at 20 kHz",
    licence=UNKNOWN,
    size=UNKNOWN,
    published="https://github.com/yijiaguo02/SpikeGS, https://spikegs.github.io (data announced)",
    get="ask the authors, or look whether the README there links the data by now",
    citation=_CITATION,
    layout=f"""
{_SHARED}
SCENE/images/NUMBER.png and SCENE/tfp/NUMBER.png: images made of the spikes around frame NUMBER
SCENE/sparse/0: COLMAP's model of the images
""",
    certainty="images, tfp and sparse are read in the authors' README and loader; the stream beside them is a guess",
    recognises=recognises_real,
    read=read_real,
)

SYNTHETIC = DatasetKind(
    name="spikegs-synthetic",
    title="SpikeGS, synthetic scenes",
    sensor="colour, simulated, of the size of the pictures; taken as 20 kHz",
    licence=UNKNOWN,
    size=UNKNOWN,
    published=REAL.published,
    get=REAL.get,
    citation=_CITATION,
    layout=f"""
{_SHARED}
SCENE/transforms_train.json, transforms_test.json, transforms_TFP.json: poses as Blender's scenes have them
pictures named by the number of their frame
""",
    certainty="the three files are read in the authors' loader; the stream beside them is a guess",
    recognises=recognises_synthetic,
    read=read_synthetic,
)
