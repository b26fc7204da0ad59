"""SPICE-HL3: a rover in a lunar analogue, seen by a SPAD512S among others; its one-bit frames are read.

The camera's files hold frames of 512x512 bits, the leftmost pixel in the highest bit, and end with the four bytes DONE.
The authors' readers turn each frame by 90 degrees counter-clockwise; the frames that they export as PNG are turned.
"""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.camera import MOST_SIDE
from spiked.datasets.clip import Clip
from spiked.datasets.kind import DatasetKind
from spiked.datasets.pictures import picture_size
from spiked.datasets.spikes import CHUNK_FRAMES, files_in, truth_beside
from spiked.errors import DatasetError
from spiked.natural_order import natural
from spiked.recording.geometry import DEFAULT_RATE_HZ
from spiked.sensor import Response, Sensor

SIDE = 512
"""Pixels of a side of the sensor."""
FRAME_BYTES = SIDE * SIDE // 8
"""Bytes of a frame."""
END = b"DONE"
"""Last bytes of a file of the camera."""
Blocks = Callable[[], Iterator[NDArray[np.uint8]]]
"""Frames as `Clip.blocks` gives them."""
_PNG = re.compile(r"spad_(.+)_frame(\d+)", re.IGNORECASE)
_STAMPED = re.compile(r"RAW_[\d.]+")
"""Files of the authors' own programs, one for each burst of frames."""


def recognises(folder: Path) -> bool:
    """Whether there are files of the camera, or exported frames."""
    return bool(_bins(folder)) or any(_PNG.fullmatch(path.stem) for path in files_in(folder, ".png", deep=True))


def read(folder: Path) -> tuple[Clip, ...]:
    """A clip for each acquisition, and for each burst. Raises DatasetError."""
    groups: dict[str, list[Path]] = {}
    for path in _bins(folder):
        stamped = _STAMPED.fullmatch(path.stem) is not None
        place = path if stamped else path.parent
        groups.setdefault(_name(folder, place, path.stem if stamped else ""), []).append(path)
    clips = [_of_bins(name, files) for name, files in groups.items()]
    pictures: dict[str, list[Path]] = {}
    for path in files_in(folder, ".png", deep=True):
        if _PNG.fullmatch(path.stem):
            pictures.setdefault(_name(folder, path.parent, ""), []).append(path)
    return (*clips, *(_of_pictures(name, files) for name, files in pictures.items()))


def _bins(folder: Path) -> list[Path]:
    return [path for path in files_in(folder, ".bin", deep=True) if path.name.upper().startswith("RAW")]


def _name(folder: Path, place: Path, stem: str) -> str:
    if stem:
        place = place.with_name(stem.replace(".", "_"))
    return "frames" if place == folder else place.relative_to(folder).as_posix()


def _clip(name: str, files: list[Path], size: tuple[int, int], frames: int, blocks: Blocks) -> Clip:
    sensor = Sensor(*size, DEFAULT_RATE_HZ, flipped=False, response=Response.BERNOULLI)
    truth = truth_beside(files[0])
    return Clip(name, tuple(files), sensor, frames, blocks, assumed=("frame_rate",), truth=truth)


def _of_bins(name: str, files: list[Path]) -> Clip:
    parts = [_frames(path) for path in files]

    def blocks() -> Iterator[NDArray[np.uint8]]:
        for part in parts:
            for begin in range(0, len(part), CHUNK_FRAMES):
                yield turned(np.asarray(part[begin : begin + CHUNK_FRAMES]))

    return _clip(name, files, (SIDE, SIDE), sum(map(len, parts)), blocks)


def turned(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Frames of the camera, uint8 [n, 32768], MSB first, turned upright; compact, LSB first, uint8 [n, 32768]."""
    bits = np.unpackbits(frames, axis=1).reshape(-1, SIDE, SIDE)
    upright = np.rot90(bits, axes=(1, 2))
    return np.packbits(upright, axis=2, bitorder="little").reshape(len(frames), -1)


def _frames(path: Path) -> NDArray[np.uint8]:
    """The frames of a file, uint8 [n, 32768]. Raises DatasetError."""
    size = path.stat().st_size
    frames, rest = divmod(size, FRAME_BYTES)
    data = np.memmap(path, np.uint8, "r") if size else np.empty(0, np.uint8)
    if frames == 0 or rest != len(END) or data[-len(END) :].tobytes() != END:
        raise DatasetError(
            f"{path}: its {size} bytes are not whole frames of 512x512 bits with DONE at the end: it is "
            "cut, or not of one-bit frames"
        )
    return data[: frames * FRAME_BYTES].reshape(frames, FRAME_BYTES)


def _of_pictures(name: str, files: list[Path]) -> Clip:
    found = {path: match for path in files if (match := _PNG.fullmatch(path.stem))}
    ordered = sorted(found, key=lambda path: (natural(found[path][1]), int(found[path][2])))
    size = picture_size(ordered[0])
    if size[0] % 8 or max(size) > MOST_SIDE:
        raise DatasetError(f"{ordered[0]}: {size[0]}x{size[1]} pixels are no frame of the SPAD512S")

    def blocks() -> Iterator[NDArray[np.uint8]]:
        for begin in range(0, len(ordered), CHUNK_FRAMES):
            pixels = np.stack([_pixels(path, size) for path in ordered[begin : begin + CHUNK_FRAMES]])
            yield np.packbits(pixels, axis=2, bitorder="little").reshape(len(pixels), -1)

    return _clip(name, ordered, size, len(ordered), blocks)


def _pixels(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """A frame exported as a picture, bool [height, width]. Raises DatasetError."""
    if picture_size(path) != size:
        raise DatasetError(f"{path}: this frame is not {size[0]}x{size[1]} as the others; copy the folder anew")
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise DatasetError(f"{path}: this frame cannot be read; copy it anew")
    if len(np.unique(picture)) > 2:
        raise DatasetError(f"{path}: this picture has more than two values: only one-bit frames are read")
    return np.asarray(picture > 0)


KIND = DatasetKind(
    name="spice-hl3",
    title="SPICE-HL3, one-bit frames of the single-photon camera",
    sensor="single-photon camera Pi Imaging SPAD512S, 512x512",
    licence="data CC BY 4.0, code MIT",
    size="1 to 10 million files with the other cameras; 32 KiB a frame",
    published="https://zenodo.org/records/13970078, https://huggingface.co/datasets/UMASpaceRobotics/spice-hl3",
    get="download the archives of a trajectory from https://zenodo.org/records/13970078 and unpack its SPAD frames",
    citation="D. Rodriguez-Martinez et al., SPICE-HL3: Single-Photon, Inertial, and Stereo Camera dataset for "
    "Exploration of High-Latitude Lunar Landscapes, Scientific Data 2026, arXiv:2506.22956",
    layout="""
**/acqNNNNN/RAWNNNNN.bin: frames of 32,768 bytes, MSB first, then DONE; the files of a folder follow one another
**/RAW_TIME.bin: a burst of frames, the same
or **/spad_TIME_frameN.png: frames exported by the authors' program, already turned
""",
    certainty="read in the authors' programs; the published archives were not seen, and the rate is not in the files",
    recognises=recognises,
    read=read,
)
