"""Photon cubes of the WISION lab: packed `.npy` files or folders of `.bin` files, and masks of hot pixels.

What `photoncube2video` and `photoncube` of the lab read. Colour cubes with a fourth axis, as those of the Single Photon
Challenge, are not read.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.datasets.clip import Clip
from spiked.datasets.kind import UNKNOWN, DatasetKind
from spiked.datasets.pictures import picture_size
from spiked.datasets.spikes import CHUNK_FRAMES, array_clip, files_in, unreadable
from spiked.errors import DatasetError
from spiked.natural_order import natural
from spiked.numpy_files import UNREADABLE
from spiked.sensor import Response, Sensor

RATE_HZ = 97_700.0
"""The fastest rate of SwissSPAD2, where no folder says another."""
WIDTH, HALF_HEIGHT, FULL_HEIGHT = 512, 256, 512
"""Pixels of frames in `.bin` files, of half of the array or of the whole."""
COLMAP_FILES = ("cameras", "images", "points3D", "frames", "rigs")
"""Names of the binary files of a COLMAP model."""
_MASK_NAME = re.compile("mask|(?<![a-z])(hot|dead|inpaint)")
"""In the name of a file with pixels to leave out; a photon cube is none."""


def recognises(folder: Path) -> bool:
    """Whether there is a cube, or a folder of `.bin` files that are not the SPAD512S's."""
    return any(not _is_mask(path) for path in files_in(folder, ".npy", deep=True)) or bool(_bin_folders(folder))


def read(folder: Path) -> tuple[Clip, ...]:
    """A clip for each cube, with the masks of its folder and of those above it. Raises SpikedError."""
    clips = [
        array_clip(folder, path, _rate(folder, path), width=_packed_width(path), response=Response.BERNOULLI)
        for path in files_in(folder, ".npy", deep=True)
        if not _is_mask(path)
    ]
    clips += [_of_bins(folder, place, files) for place, files in _bin_folders(folder).items()]
    masks = [path for path in files_in(folder, ".npy", ".png", deep=True) if _is_mask(path)]
    return tuple(_masked(clip, masks) for clip in clips)


def _is_mask(path: Path) -> bool:
    return _MASK_NAME.search(path.stem.lower()) is not None


def _packed_width(path: Path) -> int | None:
    """Pixels of a row of a packed cube, so that a dark one is not taken for an array of 0 and 1."""
    try:
        stored = np.load(path, mmap_mode="r", allow_pickle=False)
    except UNREADABLE as error:
        raise unreadable(path, error) from error
    if stored.ndim == 4:
        raise DatasetError(f"{path}: this cube has colours in a fourth axis, which is not read; save one of them")
    return 8 * stored.shape[2] if stored.ndim == 3 and stored.dtype == np.uint8 else None


def _rate(folder: Path, path: Path) -> float:
    """Frames a second: a folder is named as in `binary/16kHz`."""
    for part in reversed(path.relative_to(folder).parts):
        found = re.fullmatch(r"([\d.]+)\s*khz", part, re.IGNORECASE)
        if found:
            return 1000 * float(found[1])
    return RATE_HZ


def _bin_folders(folder: Path) -> dict[Path, list[Path]]:
    found: dict[Path, list[Path]] = {}
    for path in files_in(folder, ".bin", deep=True):
        # Those of a SPAD512S are read as spice-hl3.
        if not path.name.startswith("RAW") and path.stem not in COLMAP_FILES:
            found.setdefault(path.parent, []).append(path)
    return {place: sorted(files, key=natural) for place, files in found.items()}


def _of_bins(folder: Path, place: Path, files: list[Path]) -> Clip:
    """Frames of `.bin` files that follow one another, leftmost pixel in the lowest bit."""
    full = any("full" in part.lower() for part in place.relative_to(folder).parts)
    height = FULL_HEIGHT if full else HALF_HEIGHT
    size = height * WIDTH // 8
    total = sum(path.stat().st_size for path in files)
    if total == 0 or total % size:
        raise DatasetError(
            f"{place}: its {len(files)} .bin files have {total} bytes, which are no whole frames of {WIDTH}x{height}: "
            "one is missing or cut (a folder of whole arrays has 'full' in its name)"
        )
    data = [np.memmap(path, np.uint8, "r") for path in files if path.stat().st_size]

    def blocks() -> Iterator[NDArray[np.uint8]]:
        rest = np.empty(0, np.uint8)
        for part in data:
            for begin in range(0, part.size, CHUNK_FRAMES * size):
                block = np.concatenate([rest, part[begin : begin + CHUNK_FRAMES * size]])
                whole = block.size // size * size
                rest = block[whole:]
                if whole:
                    yield block[:whole].reshape(-1, size)

    name = "cube" if place == folder else place.relative_to(folder).as_posix()
    sensor = Sensor(WIDTH, height, _rate(folder, place), flipped=False, response=Response.BERNOULLI)
    return Clip(name, tuple(files), sensor, total // size, blocks, assumed=("frame_rate", "flipped"))


def _masked(clip: Clip, masks: list[Path]) -> Clip:
    own = [path for path in masks if clip.files[0].is_relative_to(path.parent)]
    if not own:
        return clip
    dead = np.zeros((clip.sensor.height, clip.sensor.width), bool)
    for path in own:
        mask = _read_mask(path)
        if mask.shape != dead.shape:
            raise DatasetError(
                f"{path}: this mask is of {mask.shape[1]}x{mask.shape[0]} pixels and {clip.files[0].name} of "
                f"{clip.sensor.width}x{clip.sensor.height}: it is of another cube; move it to that one's folder"
            )
        dead |= mask
    return replace(clip, dead=dead, described_by=tuple(own))


def _read_mask(path: Path) -> NDArray[np.bool_]:
    """Pixels to leave out, bool [height, width]. Raises RecordingError and DatasetError."""
    if path.suffix.lower() == ".png":
        picture_size(path)
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if picture is None:
            raise DatasetError(f"{path}: this mask cannot be read; copy it anew")
        return np.asarray(picture > 0)
    try:
        mask = np.load(path, mmap_mode="r", allow_pickle=False)
    except UNREADABLE as error:
        raise unreadable(path, error) from error
    if mask.ndim != 2:
        raise DatasetError(f"{path}: this mask has the shape {list(mask.shape)}: masks are [rows, columns]")
    return np.asarray(mask != 0)


KIND = DatasetKind(
    name="wision",
    title="Photon cubes of the WISION lab",
    sensor="single-photon cameras (SwissSPAD2: 512x256 or 512x512, up to 97.7 kHz), and simulated ones",
    licence=UNKNOWN,
    size="16 KiB a frame of 512x256; " + UNKNOWN,
    published="https://wisionlab.com, https://github.com/WISION-Lab/photoncube2video (the format)",
    get="follow the links of a project's page there; name a folder by the rate (16kHz) if the page states it",
    citation="S. Jungerman, A. Ingle and M. Gupta, Panoramas from Photons, ICCV 2023",
    layout="""
**/*.npy: uint8 [frames, rows, columns / 8], the leftmost pixel in the highest bit, rows top-down
or **/*.bin in a folder: frames of 512x256 one after the other, the leftmost pixel in the lowest bit; 512x512 under a
folder with 'full' in its name
*mask*, *hot*, *dead* or *inpaint* .npy or .png [rows, columns]: pixels to leave out, of cubes in this folder and below
a folder named as 16kHz states the rate
""",
    certainty="read in the lab's code; the rate is not in the files",
    recognises=recognises,
    read=read,
)
