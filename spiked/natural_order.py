"""The order of names in which people number things."""

import re
from pathlib import PurePath

__all__ = ["natural"]


def natural(name: str | PurePath) -> list[tuple[int, str]]:
    """A key that sorts names and paths with their digits as numbers: `frame2` before `frame10`."""
    # isdecimal, not isdigit: that is true of ², which is no number to int().
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", str(name))]
