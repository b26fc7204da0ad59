"""Spikes to trajectory and scene: views, sparse odometry, depth, mapping and refinement behind one `Reconstructor`."""

from spiked.recon.odometry.tracking_state import State
from spiked.recon.options import MapOptions, Options
from spiked.recon.reconstructor import Reconstructor
from spiked.recon.report import Sample, Status, Tracked

__all__ = ["MapOptions", "Options", "Reconstructor", "Sample", "State", "Status", "Tracked"]
