"""The MP4 of a result, read back by PyAV."""

from pathlib import Path

import av
import numpy as np

from spiked.export import ExportOptions, ExportSource, find_kind
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
