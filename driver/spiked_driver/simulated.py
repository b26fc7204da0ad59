"""The simulated camera as a source."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SourceError
from spiked.ring import Condition, DeviceState, End, EndReason, Gap
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.simulate.camera import DEFAULT_FOV_DEG
from spiked_driver.source import Chunk, Pacer


class SimulatedSource:
    """A hand-held camera in a procedural room; the same seed gives the same frames.

    `flow_px` is the mean image motion a frame. `frames` bounds the capture, None: no end. `pace` is a factor of the
    sensor's rate; a machine that cannot simulate so fast delivers later, never less. With 0 frames come as fast as
    lossless consumers take them.
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
    ) -> None:
        intrinsics = sensor.intrinsics or Intrinsics.from_fov(sensor.width, sensor.height, DEFAULT_FOV_DEG)
        self._sensor = replace(sensor.compact(), intrinsics=intrinsics)
        self._seed = seed
        self._motion = motion
        self._flow_px = flow_px
        self._threads = threads
        self._frames = frames
        self._pace = pace
        self._camera: SimulatedCamera | None = None
        self._pacer = Pacer(sensor.frame_rate_hz, pace)
        self._next = 0
        self._condition = Condition(DeviceState.IDLE)

    @property
    def sensor(self) -> Sensor:
        """As given, with compact frames and the intrinsics it is drawn with."""
        return self._sensor

    @property
    def frames(self) -> int | None:
        """As given."""
        return self._frames

    @property
    def waits(self) -> bool:
        """Only without a pace: a paced simulation behaves like the camera, which never waits."""
        return self._pace == 0

    @property
    def condition(self) -> Condition:
        """Armed once open, streaming from the first frame, idle after the last."""
        return self._condition

    def open(self) -> None:
        """Build the scene, which takes a moment, and start again at frame 0."""
        self._camera = SimulatedCamera(
            self._sensor, self._seed, self._motion, flow_px=self._flow_px, threads=self._threads
        )
        self._pacer = Pacer(self._sensor.frame_rate_hz, self._pace)
        self._next = 0
        self._condition = Condition(DeviceState.ARMED)

    def close(self) -> None:
        """Let go of the scene."""
        self._camera = None
        self._condition = Condition(DeviceState.IDLE)

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """See `Source.read_into`."""
        if self._camera is None:
            raise SourceError("the simulated camera is not open: open it before reading")
        if self._next == self._frames:
            self._condition = Condition(DeviceState.IDLE, "the simulation is at its end")
            return End(self._next, EndReason.FINISHED)
        count = len(view) if self._frames is None else min(len(view), self._frames - self._next)
        if not self._pacer.wait_for(self._next + count):
            return None
        self._condition = Condition(DeviceState.STREAMING)
        view[:count] = self._camera.next_frames(count)
        chunk = Chunk(self._next, count)
        self._next += count
        return chunk
