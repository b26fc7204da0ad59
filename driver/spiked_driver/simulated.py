"""The simulated camera as a source."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from spiked.camera import Rate, Side
from spiked.errors import SourceError
from spiked.ring import DeviceState, DeviceStatus, End, EndReason, Gap
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import Lighting, MotionKind, NoiseOptions, SensorNoise, SimulatedCamera
from spiked.simulate.camera import DEFAULT_FOV_DEG
from spiked_driver.source import Chunk, Pacer, former_source_names
from spiked_driver.source_kind import Device, PacedOptions, SourceKind, SourceOptions, SourceSpec, Warn


class RoomOptions(SourceOptions):
    """The camera in the room: what it is, its size and its motion."""

    width: Side = 320
    """Pixels in a row."""
    height: Side = 180
    """Rows."""
    rate: Rate = 20_000.0
    """Frames per second."""
    motion: MotionKind = MotionKind.HAND_SHAKE
    """Path of the camera."""
    flow_px: float = Field(0.12, ge=1e-4, le=8)
    """Mean image motion per frame in pixels."""
    seconds: float | None = Field(None, gt=0, le=1e7)
    """Length in seconds; without it the simulation does not end."""
    seed: int = Field(0, ge=0, lt=1 << 32)
    """The same seed gives the same frames."""
    threads: int = Field(1, ge=1, le=64)
    """Threads of the simulation. The frames do not depend on it."""


class SimulationOptions(PacedOptions, NoiseOptions, RoomOptions):
    """Options of `sim:`. Fields of the last base come first: the camera, its noise, then faults and pace."""


@former_source_names
class SimulatedSource:
    """A hand-held camera in a procedural room; the same seed gives the same frames.

    `flow_px` is the mean image motion in pixels per frame. `frames` is the length of the capture; None: no end. `pace`
    is a factor of the sensor's rate; a slow machine delivers late and loses nothing. With 0, frames come as fast as
    lossless consumers take them. `noise` and `lighting` are those of `SimulatedCamera`.
    """

    def __init__(
        self,
        sensor: Sensor,
        *,
        seed: int = 0,
        motion: MotionKind = MotionKind.HAND_SHAKE,
        flow_px: float = 0.12,
        frames: int | None = None,
        pace: float = 1.0,
        threads: int = 1,
        noise: SensorNoise | None = None,
        lighting: Lighting | None = None,
    ) -> None:
        intrinsics = sensor.intrinsics or Intrinsics.from_fov(sensor.width, sensor.height, DEFAULT_FOV_DEG)
        self._sensor = replace(sensor.compact(), intrinsics=intrinsics)
        self._seed = seed
        self._motion = motion
        self._flow_px = flow_px
        self._threads = threads
        self._noise = noise
        self._lighting = lighting
        self._frames = frames
        self._pace = pace
        self._camera: SimulatedCamera | None = None
        self._pacer = Pacer(sensor.frame_rate_hz, pace)
        self._next = 0
        self._device_status = DeviceStatus(DeviceState.IDLE)

    @property
    def sensor(self) -> Sensor:
        """The sensor as passed, with compact frames and the intrinsics of the rendering."""
        return self._sensor

    @property
    def frames(self) -> int | None:
        """Number of frames of the capture; None: no end."""
        return self._frames

    @property
    def can_block(self) -> bool:
        """Without a pace only: a paced simulation behaves like a camera, which does not wait."""
        return self._pace == 0

    @property
    def device_status(self) -> DeviceStatus:
        """Armed once open, streaming from the first frame, idle after the last."""
        return self._device_status

    def open(self) -> None:
        """Build the scene and start at frame 0."""
        self._camera = SimulatedCamera(
            self._sensor,
            self._seed,
            self._motion,
            noise=self._noise,
            flow_px=self._flow_px,
            lighting=self._lighting,
            threads=self._threads,
        )
        self._pacer = Pacer(self._sensor.frame_rate_hz, self._pace)
        self._next = 0
        self._device_status = DeviceStatus(DeviceState.ARMED)

    def close(self) -> None:
        """Free the scene."""
        self._camera = None
        self._device_status = DeviceStatus(DeviceState.IDLE)

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """See `Source.read_into`."""
        if self._camera is None:
            raise SourceError("the simulated camera is not open: open it before reading")
        if self._next == self._frames:
            self._device_status = DeviceStatus(DeviceState.IDLE, "the simulation has ended")
            return End(self._next, EndReason.FINISHED)
        count = len(view) if self._frames is None else min(len(view), self._frames - self._next)
        if not self._pacer.wait_for(self._next + count):
            return None
        self._device_status = DeviceStatus(DeviceState.STREAMING)
        view[:count] = self._camera.next_frames(count)
        chunk = Chunk(self._next, count)
        self._next += count
        return chunk


def _open(spec: SourceSpec, options: SimulationOptions, warn: Warn | None) -> SimulatedSource:
    if spec.target:
        raise SourceError(f"source {spec.text!r}: sim: takes options only, as in sim:?seed=1")
    sensor = options.sensor(Sensor(options.width, options.height, options.rate))
    options.checked(sensor.response)
    return SimulatedSource(
        sensor,
        seed=options.seed,
        motion=options.motion,
        flow_px=options.flow_px,
        frames=None if options.seconds is None else round(options.seconds * options.rate),
        pace=options.pace,
        threads=options.threads,
        noise=options.noise(),
        lighting=options.lighting(),
    )


def _describe(spec: SourceSpec) -> Device:
    return Device(spec.text, KIND.name, "configured with --device")


def _find() -> list[Device]:
    room = "simulated hand-held camera in a built-in room; options seed, seconds, width, height, mosaic"
    return [Device(KIND.usage, KIND.name, room)]


KIND = SourceKind(
    name="sim",
    usage="sim:",
    summary="a simulated hand-held camera in a built-in room",
    options=SimulationOptions,
    open=_open,
    describe=_describe,
    find=_find,
    can_block=True,
)
