"""Images of keyframes in bounded memory."""

import numpy as np
import pytest

from spiked.recon.frontend.feature_tracks import Picture
from spiked.recon.odometry.keyframe_pictures import NEWEST_PICTURES, KeyframePictures


def picture(number: int) -> Picture:
    return np.full((10, 10), number % 256, np.uint8)


class Builder:
    """Builds the images of keyframes up to one."""

    def __init__(self, end: int) -> None:
        self.end = end
        self.built = 0

    def holds(self, view_id: int) -> bool:
        return view_id < self.end

    def build(self, view_id: int) -> Picture | None:
        self.built += 1
        return picture(view_id) if self.holds(view_id) else None


def test_images_beyond_the_memory_are_built_anew() -> None:
    builder = Builder(240)
    pictures = KeyframePictures(100 * 100, builder)
    for number in range(0, 300):
        pictures[number] = picture(number)
        assert pictures.held_bytes <= 100 * 100
    assert list(pictures) == list(range(300)) and not builder.built
    assert all((pictures[number] == number % 256).all() for number in range(300))
    assert 200 <= builder.built < 300 and pictures.held_bytes <= 100 * 100


def test_the_newest_images_are_held() -> None:
    builder = Builder(1000)
    pictures = KeyframePictures(100 * (NEWEST_PICTURES + 1), builder)
    for number in range(200):
        pictures[number] = picture(number)
    assert [pictures[number][0, 0] for number in range(5)] == list(range(5))
    built = builder.built
    assert [pictures[number][0, 0] for number in range(200 - NEWEST_PICTURES, 200)] and builder.built == built


def test_older_keyframes_are_thinned_out_where_they_cannot_be_built() -> None:
    pictures = KeyframePictures(100 * 100)
    for number in range(1000):
        pictures[number] = picture(number)
        assert pictures.held_bytes <= 100 * 100
    ids = list(pictures)
    assert ids[0] == 0 and ids[-NEWEST_PICTURES:] == list(range(1000 - NEWEST_PICTURES, 1000))
    assert ids == sorted(ids) and all((pictures[number] == number % 256).all() for number in ids)
    with pytest.raises(KeyError):
        pictures[1]
