"""How large a video may be that a service makes while others wait for it."""

from spiked.errors import ConfigurationError

__all__ = ["check_size"]

MOST_PICTURES = 36_000
"""Of a video: twenty minutes at 30 a second."""
MOST_PICTURE_PX = 4096 * 2304
"""Of a picture: the largest that H.264 has at levels 5.1 and 5.2, which players of 3840 x 2160 decode."""
MOST_PX = MOST_PICTURES * 1_000_000
"""Of all pictures: `MOST_PICTURES` of 1000 x 1000, about an hour of two cores; 9.6 minutes of 1920 x 1080 at 30 a
second."""


def check_size(seconds: float, pictures_a_second: float, width: int, height: int, effort: float = 1.0) -> int:
    """The number of pictures of a video; `effort` is the work for a pixel over that of a rendered one.

    Raises ConfigurationError for a video that is too large.
    """
    count = max(1, round(seconds * pictures_a_second))
    if count > MOST_PICTURES:
        raise ConfigurationError(
            f"{seconds:.4g} s with {pictures_a_second:g} pictures a second are {count:,} pictures, more than "
            f"{MOST_PICTURES:,}: make the video shorter, or give it fewer a second"
        )
    if width * height > MOST_PICTURE_PX:
        raise ConfigurationError(
            f"pictures of {width} x {height} have more than {MOST_PICTURE_PX:,} pixels (4096 x 2304): make them smaller"
        )
    if count * width * height * effort > MOST_PX:
        most = max(1, int(MOST_PX / (width * height * effort)))
        raise ConfigurationError(
            f"{count:,} pictures of {width} x {height} would take hours: make {most:,} at most, or smaller ones"
        )
    return count
