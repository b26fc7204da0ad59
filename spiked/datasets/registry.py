"""All kinds of data sets. A new one is its module and a line here."""

from pathlib import Path

from spiked.datasets import (
    colmap,
    deblur_nerf,
    outdoor_spike,
    recvidarreal,
    spice_hl3,
    spike_zoo,
    spikecv,
    spikegs,
    tanks_and_temples,
    transforms,
    usp_gaussian,
    wision,
)
from spiked.datasets.kind import DatasetKind
from spiked.errors import DatasetError

KINDS: tuple[DatasetKind, ...] = (
    usp_gaussian.KIND,
    spikegs.REAL,
    spikegs.SYNTHETIC,
    recvidarreal.KIND,
    spikecv.KIND,
    spike_zoo.KIND,
    outdoor_spike.KIND,
    spice_hl3.KIND,
    wision.KIND,
    colmap.KIND,
    tanks_and_temples.KIND,
    deblur_nerf.KIND,
    transforms.KIND,
)
"""In the order in which a folder is tried: special layouts come before those that contain them."""


def find_kind(name: str) -> DatasetKind:
    """The kind of this name. Raises DatasetError."""
    for kind in KINDS:
        if kind.name == name:
            return kind
    raise DatasetError(f"{name!r} is no data set known here; known are {', '.join(kind.name for kind in KINDS)}")


def recognise(folder: Path) -> tuple[DatasetKind, ...]:
    """The kinds whose layout a folder may have, the likeliest first. Raises DatasetError where there is none."""
    if not folder.is_dir():
        raise DatasetError(f"{folder}: this is no folder; unpack the data set and name its folder")
    found = tuple(kind for kind in KINDS if kind.recognises(folder))
    if not found:
        raise DatasetError(
            f"{folder} has the layout of no data set known here; `spiked datasets show NAME` prints that of each"
        )
    return found
