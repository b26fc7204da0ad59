"""What people use today: pictures made of spikes, and COLMAP on them.

A baseline gives poses at the times of some pictures; `interpolated` gives every frame one.
"""

from spiked.baselines.colmap import ColmapResult, run_colmap
from spiked.baselines.pictures import ImageKind, PictureOptions, SpikePicture, spike_pictures
from spiked.baselines.poses import interpolated

__all__ = [
    "ColmapResult",
    "ImageKind",
    "PictureOptions",
    "SpikePicture",
    "interpolated",
    "run_colmap",
    "spike_pictures",
]
