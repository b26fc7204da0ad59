"""A simulated spike camera: sensor with noise terms, furnished room, camera paths, and ground truth."""

from spiked.simulate.camera import SimulatedCamera
from spiked.simulate.motion import Motion, MotionKind, Stage, look_at, make_motion
from spiked.simulate.options import NoiseOptions
from spiked.simulate.room import Room
from spiked.simulate.sensor import GainStep, Lighting, PixelMaps, SensorNoise, SpikeSensor
from spiked.simulate.view import View, ViewableScene

__all__ = [
    "GainStep",
    "Lighting",
    "Motion",
    "MotionKind",
    "NoiseOptions",
    "PixelMaps",
    "Room",
    "SensorNoise",
    "SimulatedCamera",
    "SpikeSensor",
    "Stage",
    "View",
    "ViewableScene",
    "look_at",
    "make_motion",
]
