"""USP-Gaussian: clips of spikes around each view, with sharp pictures and COLMAP's poses.

A synthetic clip holds 177 frames: the 97 of a view's exposure and 40 more at both ends (`scripts/Dataset.md` of the
authors' repository). Views follow each other every 104 frames, so neighbouring clips overlap by 73; each was simulated
by itself, from other charges. Clips cut from one recording overlap bit by bit.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.datasets.clip import Clip, TrueView, Truth
from spiked.datasets.kind import UNKNOWN, DatasetKind
from spiked.datasets.pictures import picture_size
from spiked.datasets.spikes import PICTURE_SUFFIXES, files_in, recorded_blocks, same_sensor, whole_frames
from spiked.datasets.transforms import FILE
from spiked.errors import DatasetError
from spiked.natural_order import natural
from spiked.recording import Recording, RecordingGeometry
from spiked.recording.geometry import Assumable
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory
from spiked.transforms import Transforms

INTERPOLATED = 8
"""Frames from one rendered picture to the next: seven were inserted. Clips are numbered by rendered pictures."""
OVERLAP = 73
"""Frames that neighbouring synthetic clips have in common: 2 x 40 added ones without the 7 between two exposures."""
REAL_SIZE = (400, 250)
"""Size of the real clips, whose sharp_data are made of the spikes and are no truth."""
_SPIKES, _SHARP = "spike_data", "sharp_data"

Parts = list[tuple[int, int]]
"""First frame and end of the part of each clip that a joined recording takes."""


def scenes_in(folder: Path) -> Iterator[Path]:
    """Folders with `spike_data`: the folder itself, those in it, and those in `synthetic` and `real_world`."""
    if (folder / _SPIKES).is_dir():
        yield folder
        return
    for child in sorted(path for path in folder.iterdir() if path.is_dir()):
        if (child / _SPIKES).is_dir():
            yield child
        elif child.name in ("synthetic", "real_world"):
            yield from (scene for scene in sorted(child.iterdir()) if (scene / _SPIKES).is_dir())


def recognises(folder: Path) -> bool:
    """Whether a scene has clips."""
    return any(files_in(scene / _SPIKES, ".dat") for scene in scenes_in(folder))


def read(folder: Path) -> tuple[Clip, ...]:
    """One clip for each scene, or, where clips do not join, one for each file. Raises SpikedError."""
    return tuple(clip for scene in scenes_in(folder) for clip in _read_scene(folder, scene))


def _read_scene(folder: Path, scene: Path) -> list[Clip]:
    name = "scene" if scene == folder else scene.relative_to(folder).as_posix()
    files, pictures = files_in(scene / _SPIKES, ".dat"), files_in(scene / _SHARP, *PICTURE_SUFFIXES)
    if not files:
        raise DatasetError(f"{scene / _SPIKES} has no .dat file; copy the scene anew")
    size = picture_size(pictures[0]) if pictures else REAL_SIZE
    given = RecordingGeometry(*size, flipped=True)
    recordings = [whole_frames(path, given) for path in files]
    sensor = same_sensor(scene, recordings)
    assumed: tuple[Assumable, ...] = ("frame_rate", "bit_order")
    notes: tuple[str, ...] = ()
    parts = _overlapping(recordings)
    if parts is None and (parts := _by_number(recordings)) is not None:
        notes = (
            f"{name}: the clips were simulated one by one, so the charges of all pixels jump every "
            f"{parts[0][1] - parts[0][0]} frames",
        )
    if parts is None:
        return [
            Clip(f"{name}/{r.path.stem}", (r.path,), sensor, r.frames, _reader([r], [(0, r.frames)]), assumed=assumed)
            for r in recordings
        ]
    starts = np.cumsum([0, *(stop - first for first, stop in parts)])
    middles = [int(s) - first + r.frames // 2 for s, (first, _), r in zip(starts[:-1], parts, recordings, strict=True)]
    truth = _truth(scene, np.array(middles, np.float64), sensor, pictures if size != REAL_SIZE else [])
    blocks = _reader(recordings, parts)
    clip = Clip(name, tuple(files), sensor, int(starts[-1]), blocks, assumed=assumed, notes=notes, truth=truth)
    return [clip if truth.path is None else replace(clip, described_by=(scene / FILE,))]


def _reader(recordings: list[Recording], parts: Parts) -> Callable[[], Iterator[NDArray[np.uint8]]]:
    def blocks() -> Iterator[NDArray[np.uint8]]:
        for recording, (first, stop) in zip(recordings, parts, strict=True):
            yield from recorded_blocks(recording, first, stop)

    return blocks


def _overlapping(recordings: list[Recording]) -> Parts | None:
    """Parts without what the next clip repeats bit by bit; None where no clip repeats anything.

    Raises DatasetError where some do and others do not.
    """
    shared = [_shared(a, b) for a, b in pairwise(recordings)]
    if not any(shared):
        return [(0, recordings[0].frames)] if len(recordings) == 1 else None
    if not all(shared):
        gap = shared.index(0)
        raise DatasetError(
            f"{recordings[gap + 1].path} does not go on where {recordings[gap].path.name} ends, as the other clips do: "
            "one between them is missing, or one of them is damaged"
        )
    return [(0, r.frames - count) for r, count in zip(recordings, [*shared, 0], strict=True)]


def _shared(before: Recording, after: Recording) -> int:
    """Frames at the end of a clip with which the next begins."""
    first = np.asarray(after.data[0])
    for begin in range(before.frames):
        if np.array_equal(before.data[begin], first):
            count = before.frames - begin
            if count <= after.frames and np.array_equal(before.data[begin:], after.data[:count]):
                return count
    return 0


def _by_number(recordings: list[Recording]) -> Parts | None:
    """Parts around the middle of synthetic clips, which are numbered by rendered pictures; None for other clips.

    Raises DatasetError for a clip that is missing.
    """
    stems = [recording.path.stem for recording in recordings]
    frames = {recording.frames for recording in recordings}
    if not all(stem.isdigit() for stem in stems) or len(frames) > 1:
        return None
    count = frames.pop()
    between, odd = divmod(count - OVERLAP, INTERPOLATED)
    steps = np.diff([int(stem) for stem in stems])
    if odd or between < 1 or not (steps % between == 0).all():
        return None
    if (steps != between).any():
        after = stems[int(np.flatnonzero(steps != between)[0])]
        raise DatasetError(f"{recordings[0].path.parent}: the clip after {after} is missing; copy the scene anew")
    margin = (count - INTERPOLATED * between) // 2
    inner = (margin, margin + INTERPOLATED * between)
    return [(0, inner[1]), *[inner] * (len(recordings) - 2), (inner[0], count)]


def _truth(scene: Path, middles: NDArray[np.float64], sensor: Sensor, pictures: list[Path]) -> Truth:
    """Poses and sharp pictures at the middles of the clips. Raises SceneError and DatasetError."""
    path = scene / FILE
    if not path.is_file():
        return Truth()
    content = Transforms.read(path)
    order = sorted(range(len(content.frames)), key=lambda row: natural(content.frames[row].file_path))
    poses = content.poses(path)[order]
    for what, count in (("poses in transforms.json", len(poses)), (f"pictures in {_SHARP}", len(pictures))):
        if count not in (0, len(middles)):
            raise DatasetError(f"{scene} has {len(middles)} clips and {count} {what}: a clip or a picture is missing")
    times = (middles + 0.5) / sensor.frame_rate_hz
    views = [TrueView(*seen) for seen in zip(pictures, times.tolist(), poses, strict=False)]
    return Truth(Trajectory(times, poses[:, :3, :3], poses[:, :3, 3]), tuple(views))


KIND = DatasetKind(
    name="usp-gaussian",
    title="USP-Gaussian, synthetic and real scenes",
    sensor="grey, 600x400 simulated (Deblur-NeRF scenes) or 400x250 real at 20 kHz",
    licence="the code is under the MIT licence; that of the data is " + UNKNOWN,
    size="177 frames (5.3 MB) a clip of a synthetic scene, about 30 clips each",
    published="https://github.com/chenkang455/USP-Gaussian (the README links the data)",
    get="follow the download link in the README there and unpack it as data/synthetic and data/real_world",
    citation="K. Chen et al., USP-Gaussian: Unifying Spike-based Image Reconstruction, Pose Correction and Gaussian "
    "Splatting, CVPR 2025",
    layout="""
SCENE/spike_data/NUMBER.dat: clips, LSB first, rows bottom-up, of the size of the pictures
SCENE/sharp_data/NUMBER.png: a picture for the middle of each clip
SCENE/transforms.json: a pose for each clip, in the order of names
SCENE may be the folder itself, or each folder in it, in synthetic/ or in real_world/
""",
    certainty="read in the authors' code and notes",
    recognises=recognises,
    read=read,
)
