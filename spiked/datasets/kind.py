"""The record of a data set: what it is called and where it is from, how its folders are recognised and opened."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from spiked.datasets.clip import Dataset, Item
from spiked.errors import DatasetError

UNKNOWN = "not known here; see the authors' page"
"""In place of a licence or a size that no source states."""


@dataclass(frozen=True)
class DatasetKind:
    """A data set, or a layout that several share."""

    name: str
    title: str
    sensor: str
    """Camera, size and rate."""
    licence: str
    size: str
    published: str
    """Where the authors publish it."""
    get: str
    """What to do to have it on this machine; nothing here does it."""
    citation: str
    layout: str
    """Files and folders, a line each."""
    certainty: str
    """How the layout is known."""
    recognises: Callable[[Path], bool]
    """Whether a folder looks like it, by names alone."""
    read: Callable[[Path], tuple[Item, ...]]
    """Clips and scenes of a folder. Raises SpikedError."""

    def open(self, folder: Path) -> Dataset:
        """Open a folder. Raises DatasetError for one of another layout, and SpikedError for damaged files."""
        folder = Path(os.path.abspath(folder))  # noqa: PTH100  (resolve() would follow links)
        if not folder.is_dir():
            raise DatasetError(f"{folder}: this is no folder; unpack the data set and name its folder")
        if not self.recognises(folder):
            expected = "; ".join(line.strip() for line in self.layout.strip().splitlines())
            raise DatasetError(f"{folder} has not the layout of {self.name}: {expected}")
        items = self.read(folder)
        if not items:
            raise DatasetError(f"{folder}: nothing of {self.name} is in it; see `spiked datasets show {self.name}`")
        names = [item.name for item in items]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise DatasetError(f"{folder} has two clips {twice!r}: keep one of them")
        return Dataset(self.name, folder, items)
