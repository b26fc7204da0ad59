"""Poses of pictures: TUM files with their times, or nerfstudio's transforms.json with their names."""

from pathlib import Path

from spiked.errors import SceneError
from spiked.natural_order import natural
from spiked.sensor import Intrinsics
from spiked.simulate.pictures.reading import Pictures
from spiked.trajectory import Trajectory
from spiked.transforms import Transforms


def read_poses(file: Path, pictures: Pictures, size: tuple[int, int]) -> tuple[Trajectory, Intrinsics | None]:
    """Camera-to-world poses on the clock of the pictures, and the optics of the pictures if the file states them.

    file: a TUM file, or a `transforms.json`, whose frames are those pictures that have their names; of a video they are
    all its pictures, in their order. size: width and height of the pictures. Raises SceneError.
    """
    if file.suffix.lower() != ".json":
        return Trajectory.read_tum(file), None
    content = Transforms.read(file)
    frames = content.frames
    matrices = content.poses(file)
    if pictures.names:
        numbers = {Path(name).stem: number for number, name in enumerate(pictures.names)}
        found = {
            numbers[stem]: entry
            for entry, frame in enumerate(frames)
            if (stem := Path(frame.file_path).stem) in numbers
        }
        if len(found) < 2:
            raise SceneError(
                f"{file} has poses of {len(found)} of the pictures in {pictures.path}; names must be equal"
            )
    elif len(frames) == len(pictures.times_s):
        found = dict(enumerate(sorted(range(len(frames)), key=lambda entry: natural(frames[entry].file_path))))
    else:
        raise SceneError(
            f"{file} has {len(frames)} poses and the video {len(pictures.times_s)} pictures; give a pose for each, "
            "or a TUM file with times"
        )
    order = sorted(found)
    posed = matrices[[found[number] for number in order]]
    return Trajectory(pictures.times_s[order], posed[:, :3, :3], posed[:, :3, 3]), content.intrinsics(file, size)
