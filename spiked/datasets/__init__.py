"""Public data sets: readers of their folders, and checksums of what was downloaded.

`recognise` finds the kind of a folder, `DatasetKind.open` its clips and scenes. A clip becomes a recording by
`Clip.write`. No network is used.
"""

from spiked.datasets.clip import Clip, Dataset, PictureScene, TrueView, Truth
from spiked.datasets.kind import DatasetKind
from spiked.datasets.lock import Comparison, compare
from spiked.datasets.registry import KINDS, find_kind, recognise

__all__ = [
    "KINDS",
    "Clip",
    "Comparison",
    "Dataset",
    "DatasetKind",
    "PictureScene",
    "TrueView",
    "Truth",
    "compare",
    "find_kind",
    "recognise",
]
