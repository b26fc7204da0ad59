"""Spikes to trajectory and scene: views, sparse odometry, depth, mapping and refinement behind one `Reconstructor`.

`MapIndex` and `Localiser` find a camera in a scene that is known; `merge` makes one map of two, and `extend` one of a
map and a reconstruction.
"""

import lazy_loader

# The names are those of __init__.pyi. A module is imported when one of its names is asked for: many processes need only
# options and states, and all modules take a second.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
