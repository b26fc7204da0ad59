"""The MP4 of a result, read back by PyAV."""

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from spiked.errors import ConfigurationError, SpikedError
from spiked.export import ExportOptions, ExportSource, find_kind
from spiked.frame_of_reference import KnownScale
from spiked.pose import quaternion
from spiked.simulate import Room
from spiked.video import smoothed_path

from ..room_map import OPTICS, SENSOR


def test_a_video_shows_the_room_from_the_path(source: ExportSource, tmp_path: Path) -> None:
    said = find_kind("video").write(source, tmp_path / "a.mp4", ExportOptions(seconds=0.5))
    assert said == f"15 pictures of {SENSOR.width} x {SENSOR.height}, 0.5 s"
    with av.open(str(tmp_path / "a.mp4")) as file:
        pictures = [frame.to_ndarray(format="gray") for frame in file.decode(video=0)]
    assert len(pictures) == 15
    rotations, centres = smoothed_path(source.path).sampled(15)
    for at in (0, 7, 14):
        seen = Room(seed=3).render(OPTICS, SENSOR.width, SENSOR.height, rotations[at], centres[at]).intensity.mean(2)
        known = pictures[at] > 8  # the scene is what one view of the room saw
        assert known.mean() > 0.4
        found = [np.corrcoef(one[known], seen[known])[0, 1] for one in pictures]
        assert found[at] > 0.9
        assert abs(int(np.argmax(found)) - at) <= 1, "the picture is of its time"


def test_a_video_goes_through_chosen_poses(source: ExportSource, tmp_path: Path) -> None:
    rows = [len(source.path) - 1, len(source.path) // 2, 0]  # backwards
    poses = [(*source.path.centres[row], *quaternion(source.path.rotations[row])) for row in rows]
    options = ExportOptions(seconds=0.5, through=tuple(tuple(map(float, one)) for one in poses))
    find_kind("video").write(source, tmp_path / "a.mp4", options)
    with av.open(str(tmp_path / "a.mp4")) as file:
        pictures = [frame.to_ndarray(format="gray") for frame in file.decode(video=0)]
    for at, row in zip((0, 7, 14), rows, strict=True):
        rotation, centre = source.path.rotations[row], source.path.centres[row]
        seen = Room(seed=3).render(OPTICS, SENSOR.width, SENSOR.height, rotation, centre).intensity.mean(2)
        known = pictures[at] > 8
        assert np.corrcoef(pictures[at][known], seen[known])[0, 1] > 0.9, row


@pytest.mark.parametrize("through", [((0.0,) * 7,) * 2, ((0.0, 0.0, 0.0, 1.0),) * 2, ((0.0, 0.0, 0.0, 1.0, 0, 0, 0),)])
def test_poses_that_are_none_are_refused(
    source: ExportSource, tmp_path: Path, through: tuple[tuple[float, ...], ...]
) -> None:
    with pytest.raises(SpikedError):
        find_kind("video").write(source, tmp_path / "a.mp4", ExportOptions(through=through))
    assert not list(tmp_path.iterdir())


def test_chosen_poses_are_not_in_metres(source: ExportSource, tmp_path: Path) -> None:
    poses = ((0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),) * 2
    with pytest.raises(ConfigurationError, match="leave metres out"):
        find_kind("video").write(
            replace(source, scale=KnownScale("m", 1.0)), tmp_path / "a.mp4", ExportOptions(through=poses)
        )
