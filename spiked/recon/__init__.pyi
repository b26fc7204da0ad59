from .extension import extend
from .localisation.localiser import Localisation, LocalisedView, Localiser
from .localisation.map_index import MapIndex
from .merging.known_map import KnownMap
from .merging.merger import Merged, merge
from .merging.registration import NotOnePlaceError, Registration
from .methods import METHODS, Alternation, Initialisation, Method, MethodName, PoseStepName
from .odometry.tracking_state import State
from .options import LossName, MapOptions, Options
from .reconstructor import Reconstructor
from .status import Sample, Status, Tracked

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
