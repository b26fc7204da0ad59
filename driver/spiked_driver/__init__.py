"""Camera sources: replayed recordings, the simulated camera, and USB hardware, all behind one `Source` protocol."""

from spiked_driver.acquisition import StopEvent, acquire
from spiked_driver.faults import Faults, FaultySource, Loss, Stall
from spiked_driver.source import Chunk, Pacer, Source
from spiked_driver.spec import OpenedCamera, open_camera, open_source

__all__ = [
    "Chunk",
    "Faults",
    "FaultySource",
    "Loss",
    "OpenedCamera",
    "Pacer",
    "Source",
    "Stall",
    "StopEvent",
    "acquire",
    "open_camera",
    "open_source",
]
