"""Images compared with spikes on a GPU: against the charge loss of the CPU."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import pytest
import render_scenes as scenes
from test_gpu import DEVICES
from test_moving import relative

from spiked.calibration import Calibration
from spiked.distortion import Distortion, LensModel
from spiked.errors import ConfigurationError
from spiked.pose import exp_so3
from spiked.recon import MapOptions, Options, Reconstructor
from spiked.recon.mapping import mapper as mapping
from spiked.recon.mapping import pyramid
from spiked.recon.mapping.frame_warp import MIN_RELATIVE_DEPTH, FrameWarp
from spiked.recon.mapping.loss import ChargeComparison, WarpedChargeLoss
from spiked.recon.mapping.map_steps import ChargeStep, DeviceMapSteps, MapSteps
from spiked.recon.mapping.mapper import Mapper
from spiked.recon.mapping.render_requests import RenderRequest
from spiked.render import Camera, RenderedImage, gpu
from spiked.render.charge import ChargeLoss
from spiked.render.comparison import ChargeCompared, ChargeTerms
from spiked.render.descent import DeviceDescent, Stride
from spiked.render.splats import MeanAxes, SizeLimits
from spiked.sensor import BitOrder, Intrinsics, Mosaic, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.trajectory import Trajectory

on_devices = pytest.mark.parametrize("device", DEVICES)
BACKGROUND, WHITE = 0.1, 0.7
POSE = np.eye(3)[None], np.zeros((1, 3))
SENSOR = Sensor(88, 61, 20_000.0, intrinsics=Intrinsics(80.0, 82.0, 44.7, 30.1))


@dataclass
class Case:
    """A scene on a device, and the spikes of a camera that turns and shifts."""

    device: str
    sensor: Sensor = SENSOR
    pixel: int = 1
    phase: int = 0
    frames: int = 24
    calibration: Calibration | None = None
    splats: int = 400
    level: float = 1.05

    @cached_property
    def camera(self) -> Camera:
        assert self.sensor.intrinsics is not None
        return Camera(self.sensor.intrinsics, self.sensor.width, self.sensor.height)

    @cached_property
    def rasteriser(self) -> gpu.GpuRasteriser:
        small = Camera(
            self.camera.intrinsics.scaled(1 / self.pixel),
            self.camera.width // self.pixel,
            self.camera.height // self.pixel,
        )
        return gpu.GpuRasteriser(small, device=self.device)

    @cached_property
    def fit(self) -> DeviceDescent:
        colours = 1 if self.sensor.mosaic is None else 3
        return DeviceDescent(scenes.splats(self.splats, colours, 6), 0.9, 0.99, 1)

    @cached_property
    def warp(self) -> FrameWarp:
        rng = np.random.default_rng(2)
        bits = (rng.random((self.frames, self.sensor.frame_bytes, 8)) < 0.3).astype(np.uint8)
        times = np.linspace(-0.5, 0.5, self.frames)
        rotations = np.stack([exp_so3(np.array([0.03, -0.08, 0.1]) * t) for t in times])
        return FrameWarp(np.packbits(bits, -1)[..., 0], rotations, np.outer(times, [0.1, 0.05, 0.1]))

    @cached_property
    def loss(self) -> WarpedChargeLoss:
        return WarpedChargeLoss(ChargeLoss(self.sensor, 1), self.camera, self.calibration, floor=0.05)

    @cached_property
    def gain(self) -> np.ndarray:
        gain = np.random.default_rng(3).uniform(0.8, 1.2, (self.sensor.height, self.sensor.width))
        gain[5, 7:9] = 0
        return gain.astype(np.float32)

    def image(self) -> RenderedImage:
        return self.rasteriser.forward(self.fit.model, *POSE, background=BACKGROUND)

    def compare(self) -> ChargeCompared:
        rasteriser = self.rasteriser
        terms = ChargeTerms(
            self.pixel, self.phase, self.level, 0.05 * WHITE, WHITE, MIN_RELATIVE_DEPTH,
            self.loss.detail if self.pixel == 1 else 0.0, self.loss.detail_px,
        )  # fmt: skip
        return rasteriser.compare_charge(
            self.fit.on_device(rasteriser), *POSE, rasteriser.spikes(self.warp.frames, self.loss.kernel.layout),
            rasteriser.light(*self.loss.light(self.gain)), self.warp.motion(self.camera, POSE[0][0], POSE[1][0]),
            terms, BACKGROUND,
        )  # fmt: skip

    def expected(self) -> ChargeComparison:
        """Of the CPU, for the device's image."""
        request = RenderRequest(*POSE, warp=self.warp)
        gain = self.gain * np.float32(self.level)
        return self.loss(self.image(), request, gain, WHITE, pixel=self.pixel, phase=self.phase)


def calibration() -> Calibration:
    rng, size = np.random.default_rng(8), (SENSOR.height, SENSOR.width)
    return Calibration(
        gain=rng.uniform(0.9, 1.1, size).astype(np.float32),
        dark=rng.uniform(0, 0.02, size).astype(np.float32),
        dead=rng.random(size) < 0.01,
    )


CASES: dict[str, Callable[[str], Case]] = {
    "grey": Case,
    "mosaic": lambda device: Case(device, replace(SENSOR, mosaic=Mosaic.GBRG)),
    "stored the other way": lambda device: Case(device, replace(SENSOR, flipped=False, bit_order=BitOrder.MSB)),
    "calibrated": lambda device: Case(device, calibration=calibration()),
    "half size": lambda device: Case(device, pixel=2, phase=1),
    "a quarter, in colour": lambda device: Case(device, replace(SENSOR, mosaic=Mosaic.RGGB), pixel=4, phase=2),
    "most frames": lambda device: Case(device, frames=64),
    "few splats": lambda device: Case(device, splats=40),
    "no splats": lambda device: Case(device, splats=0),
}


@on_devices
@pytest.mark.parametrize("name", CASES)
def test_loss_and_slope_are_those_of_the_cpu(device: str, name: str) -> None:
    case = CASES[name](device)
    wanted, made = case.expected(), case.compare()
    assert made.loss / WHITE**2 == pytest.approx(wanted.loss, rel=1e-6)
    assert made.brightness == pytest.approx(wanted.brightness, rel=1e-6)
    assert relative(case.rasteriser.slope(wanted.slope.shape), wanted.slope) < 1e-5
    assert relative(case.loss.error(case.rasteriser.charge_slope(), case.pixel), wanted.error) < 1e-5


@on_devices
def test_a_step_is_one_along_the_slope_and_the_same_twice(device: str) -> None:
    """Slopes come from many frames to the same pixel: in whole steps, whose order changes nothing."""
    rates, limits, axes = (2e-2, 2e-3, 3e-3, 4e-2, 5e-3), SizeLimits(float(np.log(0.1))), MeanAxes(0.01, own=True)
    made = []
    for through_memory in (False, True, False):
        case = CASES["mosaic"](device)
        before = case.fit.scene.means.copy()
        for _ in range(3):
            case.compare()
            slope = None
            if through_memory:
                slope = case.rasteriser.slope((61, 88, 3))
                case.image()
            case.fit.step(case.rasteriser, slope, rates, limits, axes)
        made.append(case.fit.scene)
    for first, *others in zip(*(one.arrays() for one in made), strict=True):
        assert all(np.array_equal(first, other) for other in others)
    assert np.abs(made[0].means - before).max() > 1e-3


@on_devices
def test_what_does_not_fit_is_told(device: str) -> None:
    case = CASES["grey"](device)
    rasteriser, scene, warp = case.rasteriser, case.fit.on_device(case.rasteriser), case.warp
    layout, motion = case.loss.kernel.layout, warp.motion(case.camera, POSE[0][0], POSE[1][0])
    spikes, light = rasteriser.spikes(warp.frames, layout), rasteriser.light(case.gain, None)
    terms = ChargeTerms(1, 0, 1.0, 0.05, 1.0, MIN_RELATIVE_DEPTH, 0.0, 1.5)
    with pytest.raises(ConfigurationError, match="no image was compared"):
        rasteriser.charge_slope()
    for frames in (warp.frames[:, 1:], np.repeat(warp.frames, 3, 0)):
        with pytest.raises(ConfigurationError, match="at most 64"):
            rasteriser.spikes(frames, layout)
    with pytest.raises(ConfigurationError, match="one pose"):
        rasteriser.compare_charge(scene, *scenes.poses(2, 1), spikes, light, motion, terms)
    with pytest.raises(ConfigurationError, match="of the frames"):
        rasteriser.compare_charge(scene, *POSE, spikes, light, (motion[0][1:], motion[1][1:]), terms)
    with pytest.raises(ConfigurationError, match="sensor's size"):
        rasteriser.compare_charge(scene, *POSE, spikes, rasteriser.light(case.gain[1:], None), motion, terms)
    with pytest.raises(ConfigurationError, match="gain and dark"):
        rasteriser.light(case.gain, case.gain[1:])
    for wrong in ({"floor": 0.0}, {"jitter": 0.0}, {"white": 0.0}, {"phase": 1}, {"pixel": 0}):
        with pytest.raises(ConfigurationError, match=r"positive|phase"):
            rasteriser.compare_charge(scene, *POSE, spikes, light, motion, replace(terms, **wrong))


FRAMES = 260


def reconstructed(mosaic: Mosaic | None) -> Reconstructor:
    """A short recording of the built-in room in fast motion, by the poses that it was made with."""
    sensor = Sensor(160, 104, 20_000.0, mosaic=mosaic, intrinsics=Intrinsics.from_fov(160, 104, 60))
    camera = SimulatedCamera(sensor, motion=MotionKind.ARC, flow_px=3.0)
    rotations, centres = camera.truth(np.arange(FRAMES))
    path = Trajectory((np.arange(FRAMES) + 0.5) / 20_000, rotations, centres)
    made = Reconstructor(sensor, Options(steps=45, poses=path, threads=1, mapping=MapOptions()))
    made.feed(0, camera.next_frames(FRAMES))
    made.finish()
    return made


@pytest.mark.parametrize("mosaic", [None, Mosaic.RGGB], ids=["grey", "mosaic"])
def test_a_reconstruction_of_fast_motion_is_that_of_the_cpu(
    mosaic: Mosaic | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mapping, "NUISANCES_FROM", 10)
    monkeypatch.setattr(pyramid, "SMALLEST_PIXELS", 4000)
    by_cpu: list[object] = []
    call = WarpedChargeLoss.__call__
    monkeypatch.setattr(WarpedChargeLoss, "__call__", lambda *given, **more: by_cpu.append(1) or call(*given, **more))
    made = []
    for wanted in ("emulated", "cpu"):
        monkeypatch.setenv("SPIKED_RENDER", wanted)
        made.append(reconstructed(mosaic).trainer.mapper)
        assert bool(by_cpu) == (wanted == "cpu")
    ours, theirs = made
    assert ours.fast and ours.steps == theirs.steps > 100
    pictures = [one.render(*(part[0] for part in POSE)) for one in made]
    blurred = [cv2.blur(picture, (5, 5)) for picture in pictures]
    assert np.abs(blurred[0] - blurred[1]).mean() < 0.02 * theirs.white
    assert ours.loss == pytest.approx(theirs.loss, rel=0.2)


def test_through_a_lens_with_distortion_spikes_are_compared_by_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_RENDER", "emulated")
    optics = replace(Intrinsics(80.0, 82.0, 44.7, 30.1), distortion=Distortion(LensModel.OPENCV, (-0.2, 0.05)))
    sensor, warp = replace(SENSOR, intrinsics=optics), Case("emulated").warp
    mapper = Mapper(sensor, Camera(optics, sensor.width, sensor.height), MapOptions(), 0, 1)
    mapper.adopt(scenes.splats(60, 1, 6))
    loss, still = mapper.charge_loss, Stride((0.0,) * 5, SizeLimits(), MeanAxes())
    request, level, nuisances = RenderRequest(*POSE, warp=warp), mapper.levels[0], mapper.nuisances
    step = ChargeStep(1, request, level, loss, WHITE, 0.1, 0, nuisances, False)
    assert isinstance(mapper.map_steps, DeviceMapSteps)
    losses = [steps.fit_charge(step, mapper.descent, still) for steps in (mapper.map_steps, MapSteps())]
    assert losses[0] == losses[1] > 0
    assert mapper.map_steps.charge_error.any() and not mapper.map_steps._spikes
