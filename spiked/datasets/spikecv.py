"""SpikeCV: folders of `.dat` files under a `config.yaml` with size and kind of labels."""

from pathlib import Path

from spiked.datasets.clip import Clip
from spiked.datasets.kind import UNKNOWN, DatasetKind
from spiked.datasets.spikes import files_in, name_of, recorded_clip, truth_beside
from spiked.errors import DatasetError
from spiked.recording import RecordingGeometry
from spiked.recording.arrays import open_bits
from spiked.recording.geometry import DEFAULT_RATE_HZ
from spiked.recording.sidecar import SpikeCvConfig, read_spikecv_config
from spiked.sensor import Mosaic, Sensor

CONFIG = "config.yaml"
BAYER_LABEL = 7
"""SpikeCV's id of streams behind a mosaic."""


def configs_in(folder: Path) -> dict[Path, SpikeCvConfig]:
    """Configurations of the folder and of those in it, by their folders. Raises RecordingError."""
    found = {}
    for path in sorted([folder / CONFIG, *folder.glob(f"*/{CONFIG}")]):
        config = read_spikecv_config(path) if path.is_file() else None
        if config is not None:
            found[path.parent] = config
    return found


def recognises(folder: Path) -> bool:
    """Whether there is a configuration."""
    return any(path.is_file() for path in [folder / CONFIG, *folder.glob(f"*/{CONFIG}")])


def read(folder: Path) -> tuple[Clip, ...]:
    """A clip for each `.dat`. Raises RecordingError and DatasetError."""
    configs = configs_in(folder)
    if not configs:
        raise DatasetError(f"{folder / CONFIG} has neither spike_w nor spike_h: it is not SpikeCV's; correct it")
    clips = []
    for path in files_in(folder, ".dat", deep=True):
        config = next((configs[parent] for parent in path.parents if parent in configs), None)
        if config is None:
            raise DatasetError(f"{path}: no {CONFIG} is in a folder above it, so its size is unknown; copy it there")
        clips.append(clip_of(folder, path, config))
    return tuple(clips)


def clip_of(folder: Path, path: Path, config: SpikeCvConfig) -> Clip:
    """The clip of a file. Raises RecordingError."""
    mosaic = Mosaic.BGGR if BAYER_LABEL in config.labeled_data_type else None
    if config.spike_w % 8 == 0:
        given = RecordingGeometry(config.spike_w, config.spike_h, flipped=True, mosaic=mosaic)
        return recorded_clip(folder, path, given)
    found = open_bits(path, config.spike_w, config.spike_h)
    sensor = Sensor(found.width, found.height, DEFAULT_RATE_HZ, flipped=True, mosaic=mosaic)
    note = f"{found.columns - found.width} of {found.columns} columns at the right are left out"
    return Clip(
        name_of(folder, path),
        (path,),
        sensor,
        found.frames,
        found.blocks,
        assumed=("frame_rate", "bit_order"),
        notes=(note,),
        truth=truth_beside(path),
    )


KIND = DatasetKind(
    name="spikecv",
    title="SpikeCV: momVidarReal2021, motVidarReal2020, BSS, PKU-Vidar-DVS and others",
    sensor="grey 400x250 at 20 kHz; BSS: 1000x1000 behind a mosaic; simulated sets of other sizes",
    licence=UNKNOWN,
    size="from 40 MB; " + UNKNOWN,
    published="https://github.com/Zyj061/SpikeCV, https://openi.pcl.ac.cn/Cordium/SpikeCV/datasets",
    get="download a set from the page of data sets there and unpack it with its config.yaml",
    citation="Y. Zheng et al., SpikeCV: Open a Continuous Computer Vision Era, arXiv:2303.11684",
    layout="""
config.yaml: spike_w, spike_h, labeled_data_type
**/*.dat: LSB first, rows bottom-up; bits of rows follow one another where spike_w is no multiple of 8
labeled_data_type 7 (bayer): BGGR of the upright image; labels are not read
the folder may hold several such folders
""",
    certainty="read in SpikeCV's code; rate and orientation are SpikeCV's defaults",
    recognises=recognises,
    read=read,
)
