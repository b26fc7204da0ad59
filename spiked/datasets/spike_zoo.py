"""Spike-Zoo: short streams with sharp pictures (REDS, SZ), streams without (real), and arrays of digits (UHSR)."""

from pathlib import Path

from spiked.datasets.clip import Clip
from spiked.datasets.kind import UNKNOWN, DatasetKind
from spiked.datasets.pictures import picture_size
from spiked.datasets.spikes import PICTURE_SUFFIXES, array_clip, files_in, recorded_clip
from spiked.recording import RecordingGeometry
from spiked.recording.geometry import DEFAULT_RATE_HZ

SPIKE_KEY = "spk"
"""Name of the array in the `.npz` files."""
SIZE = (400, 250)
"""Of streams without a picture that says theirs."""
_SPLITS = ("train", "test")
_FOLDERS = {"spike": "gt", "spike_data": "sharp_data"}
"""Names of the folder of streams, and of that of the pictures."""


def recognises(folder: Path) -> bool:
    """Whether there are splits, folders of streams, or streams by themselves."""
    if any((folder / split).is_dir() and _has_spikes(folder / split) for split in _SPLITS):
        return True
    flat = [path for path in folder.iterdir() if path.suffix in (".dat", ".npz")]
    return bool(flat) and not all(path.name.startswith("seq") for path in flat)


def read(folder: Path) -> tuple[Clip, ...]:
    """A clip for each stream. Raises RecordingError and DatasetError."""
    clips = []
    for path in files_in(folder, ".dat", ".npz", deep=True):
        if path.suffix == ".npz":
            clips.append(array_clip(folder, path, DEFAULT_RATE_HZ, array=SPIKE_KEY))
        else:
            clips.append(recorded_clip(folder, path, RecordingGeometry(*_size(folder, path), flipped=True)))
    return tuple(clips)


def _has_spikes(split: Path) -> bool:
    return any((split / name).is_dir() for name in _FOLDERS) or bool(files_in(split, ".dat", ".npz", deep=True))


def _size(folder: Path, path: Path) -> tuple[int, int]:
    """Width and height of a stream: those of the pictures of its split."""
    for parent in path.parents:
        pictures = parent.parent / _FOLDERS.get(parent.name, "")
        if parent.name in _FOLDERS and pictures.is_dir():
            found = files_in(pictures, *PICTURE_SUFFIXES, deep=True)
            if found:
                return picture_size(found[0])
        if parent == folder:
            break
    return SIZE


KIND = DatasetKind(
    name="spike-zoo",
    title="Spike-Zoo: REDS, SZ, real streams, UHSR",
    sensor="grey, 400x250 simulated (REDS) or real at 20 kHz; UHSR: arrays of 200 frames",
    licence="the code is under the MIT licence; that of the data is that of each set, " + UNKNOWN,
    size="301 frames (3.8 MB) a test stream of REDS; " + UNKNOWN,
    published="https://github.com/chenkang455/Spike-Zoo (its pages on data sets link each of them)",
    get="follow the links on the page of data sets there and unpack into one folder with train/ and test/",
    citation="K. Chen and Z. Ye, Spike-Zoo: A Toolbox for Spike-to-Image Reconstruction, 2025; J. Zhao et al., "
    "Spk2ImgNet, CVPR 2021 (REDS); J. Zhao et al., AAAI 2024 (UHSR)",
    layout="""
{train,test}/spike/*.dat with {train,test}/gt/*.png; or spike_data and sharp_data
{train,test}/**/*.npz: array `spk` [frames, rows, columns] (UHSR; its authors crop rows and columns 13 to 236)
or *.dat by themselves
.dat: LSB first, rows bottom-up, of the size of the pictures, else 400x250
""",
    certainty="read in the code and the pages of Spike-Zoo; which way up the arrays come is not stated",
    recognises=recognises,
    read=read,
)
