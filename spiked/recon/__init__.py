"""Spikes to trajectory and scene: views, sparse odometry, depth, mapping and refinement behind one `Reconstructor`.

`MapIndex` and `Localiser` find a camera in a scene that is known; `merge` makes one map of two, and `extend` one of a
map and a reconstruction.
"""

from spiked.recon.extension import extend
from spiked.recon.localisation.localiser import Localisation, LocalisedView, Localiser
from spiked.recon.localisation.map_index import MapIndex
from spiked.recon.merging.known_map import KnownMap
from spiked.recon.merging.merger import Merged, merge
from spiked.recon.merging.registration import NotOnePlaceError, Registration
from spiked.recon.methods import METHODS, Alternation, Initialisation, Method, MethodName, PoseStepName
from spiked.recon.odometry.tracking_state import State
from spiked.recon.options import LossName, MapOptions, Options
from spiked.recon.reconstructor import Reconstructor
from spiked.recon.report import Sample, Status, Tracked

__all__ = [
    "METHODS",
    "Alternation",
    "Initialisation",
    "KnownMap",
    "Localisation",
    "LocalisedView",
    "Localiser",
    "LossName",
    "MapIndex",
    "MapOptions",
    "Merged",
    "Method",
    "MethodName",
    "NotOnePlaceError",
    "Options",
    "PoseStepName",
    "Reconstructor",
    "Registration",
    "Sample",
    "State",
    "Status",
    "Tracked",
    "extend",
    "merge",
]
