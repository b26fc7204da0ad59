"""MP4 files, read back by PyAV: what was written, and nothing after an error."""

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest

from spiked.errors import ConfigurationError, SceneError
from spiked.video import Mp4Writer

from ..small_disk import small_disk


def read(path: Path) -> tuple[list[np.ndarray], float]:
    """Pictures, and how many there are a second."""
    with av.open(str(path)) as file:
        rate = file.streams.video[0].average_rate
        assert rate is not None
        return [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)], float(rate)


def pictures(count: int, height: int = 48, width: int = 64) -> Iterator[np.ndarray]:
    """A bright square that goes right by two pixels a picture, on a slope of colours."""
    slope = np.linspace(0, 200, width).astype(np.uint8)
    for at in range(count):
        picture = np.stack(
            [
                np.tile(slope, (height, 1)),
                np.full((height, width), 60, np.uint8),
                slope[::-1] + 0 * np.zeros((height, 1), np.uint8),
            ],
            -1,
        )
        picture[10:26, 2 * at : 2 * at + 16] = 255
        yield picture


def test_what_was_written_is_read_back(tmp_path: Path) -> None:
    with Mp4Writer(tmp_path / "a.mp4", 25, quality=5) as file:
        for picture in pictures(12):
            file.write(picture)
    found, rate = read(tmp_path / "a.mp4")
    assert (len(found), rate) == (12, 25)
    for picture, back in zip(pictures(12), found, strict=True):
        assert np.abs(picture.astype(int) - back).mean() < 4
        edges = [np.flatnonzero(one[18, :, 1] > 150)[[0, -1]] for one in (picture, back)]
        assert np.abs(edges[0] - edges[1]).max() <= 1
    assert [one.name for one in tmp_path.iterdir()] == ["a.mp4"]
    head = (tmp_path / "a.mp4").read_bytes()
    assert head.index(b"moov") < head.index(b"mdat"), "a browser can begin before it has all"


def test_grey_pictures_and_odd_sides(tmp_path: Path) -> None:
    grey = np.full((25, 41), 90, np.uint8)
    with Mp4Writer(tmp_path / "a.mp4", 29.97, quality=0) as file:
        for _ in range(3):
            file.write(grey)
    found, rate = read(tmp_path / "a.mp4")
    assert found[0].shape == (24, 40, 3) and rate == pytest.approx(29.97)
    assert np.abs(found[2].astype(int) - 90).max() <= 2


def test_an_error_leaves_the_earlier_file(tmp_path: Path) -> None:
    place = tmp_path / "a.mp4"
    place.write_bytes(b"earlier")
    with pytest.raises(SceneError, match="picture 2 is 32 x 16, the first 64 x 48"), Mp4Writer(place, 30) as file:
        for picture in pictures(2):
            file.write(picture)
        file.write(np.zeros((16, 32), np.uint8))
    with Mp4Writer(place, 30):
        pass  # no picture
    assert place.read_bytes() == b"earlier"
    assert list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize(("rate", "quality"), [(0, 20), (float("nan"), 20), (2000, 20), (30, -1), (30, 52)])
def test_what_no_video_can_have_is_refused(rate: float, quality: int, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"a video has up to|the quality of a video"):
        Mp4Writer(tmp_path / "a.mp4", rate, quality=quality)


@pytest.mark.parametrize("shape", [(1, 64), (48, 1), (16, 8194)])
def test_a_size_that_no_video_has_is_refused(shape: tuple[int, int], tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="sides of 2 to 8192 pixels"), Mp4Writer(tmp_path / "a.mp4", 30) as file:
        file.write(np.zeros(shape, np.uint8))
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MiB."""
    with small_disk(tmp_path / "disk", 1) as place:
        yield place


def test_a_full_disk_is_told_and_leaves_the_earlier_file(full_disk: Path) -> None:
    place = full_disk / "a.mp4"
    place.write_bytes(b"earlier")
    noise = np.random.default_rng(0)
    with pytest.raises(OSError, match="No space left on device"), Mp4Writer(place, 30, quality=0) as file:
        for _ in range(60):
            file.write(noise.integers(0, 256, (256, 256, 3), np.uint8))
    assert place.read_bytes() == b"earlier"
    assert list(full_disk.iterdir()) == [place]
