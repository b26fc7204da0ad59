"""recVidarReal2019: objects at high speed (classA) and a camera at high speed (classB), 400x250."""

from pathlib import Path

from spiked.datasets.clip import Clip
from spiked.datasets.kind import UNKNOWN, DatasetKind
from spiked.datasets.spikecv import CONFIG
from spiked.datasets.spikes import files_in, recorded_clip
from spiked.errors import DatasetError
from spiked.recording import RecordingGeometry
from spiked.recording.sidecar import read_spikecv_config

SIZE = (400, 250)
"""Of all streams."""
_CLASSES = ("classA", "classB")
_NAME = "vidar_reconstruction2019"
"""In the configuration of the set."""


def recognises(folder: Path) -> bool:
    """Whether there is one of the two classes, or streams with the configuration of the set."""
    if any((folder / name).is_dir() for name in _CLASSES):
        return True
    if (folder / CONFIG).is_file() and _NAME not in (folder / CONFIG).read_text("utf-8", "replace"):
        return False
    streams = files_in(folder, ".dat")
    return bool(streams) and not all(path.name.startswith("seq") for path in streams)


def read(folder: Path) -> tuple[Clip, ...]:
    """A clip for each stream. Raises RecordingError and DatasetError."""
    config = read_spikecv_config(folder / CONFIG) if (folder / CONFIG).is_file() else None
    if config is not None and (config.spike_w, config.spike_h) != SIZE:
        raise DatasetError(
            f"{folder / CONFIG} says {config.spike_w}x{config.spike_h}, and recVidarReal2019 is 400x250: "
            "it is another set; read it as spikecv"
        )
    given = RecordingGeometry(*SIZE, flipped=True)
    return tuple(recorded_clip(folder, path, given) for path in files_in(folder, ".dat", deep=True))


KIND = DatasetKind(
    name="recvidarreal",
    title="recVidarReal2019",
    sensor="grey, 400x250 at 20 kHz",
    licence=UNKNOWN,
    size="about 40 MB",
    published="https://openi.pcl.ac.cn/Cordium/SpikeCV/datasets (also linked by Spike-Zoo's README)",
    get="download recVidarReal2019 from the page there and unpack it",
    citation="L. Zhu et al., Retina-like Visual Image Reconstruction via Spiking Neural Model, CVPR 2020",
    layout="""
classA/*.dat, classB/*.dat, or *.dat by themselves: 12,500 bytes a frame, LSB first, rows bottom-up
config.yaml: SpikeCV's, 400x250
""",
    certainty="verified on bytes of car-100kmh.dat: bit order, orientation and the number of spikes",
    recognises=recognises,
    read=read,
)
