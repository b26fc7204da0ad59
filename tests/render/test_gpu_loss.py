"""Images compared with views on a GPU, and what a map learns from it: against the losses of the CPU."""

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import render_scenes as scenes
from spiked.native._dense import agreement, gain_evidence
from test_gpu import DEVICES
from test_moving import BACKGROUND, Case, relative

from spiked.errors import ConfigurationError
from spiked.recon import MapOptions, Options, Reconstructor
from spiked.recon.mapping import mapper as mapping
from spiked.recon.mapping.loss import LossName, RateLoss
from spiked.recon.mapping.map_steps import DeviceMapSteps, MapSteps, RateStep
from spiked.recon.mapping.photometric import AGREEING_SIGMAS, MODEL_ERROR, Nuisances
from spiked.recon.mapping.pyramid import Target
from spiked.render import Camera, choice, gpu, rasteriser_for
from spiked.render.comparison import Compared, DeviceFrame, FrameCache, RateTerms, ViewGains
from spiked.render.descent import DeviceDescent, Stride
from spiked.render.splats import DeviceScene, Floats, MeanAxes, SizeLimits
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Mosaic, Sensor
from spiked.simulate import SimulatedCamera
from spiked.trajectory import Trajectory

on_devices = pytest.mark.parametrize("device", DEVICES)
WHITE = 0.8


class Pair:
    """A scene on a device and a view of it there that differs a little, with pixels that saw nothing."""

    def __init__(self, device: str, name: str, ssim: float = 0.2, floor: float = 0.03, level: float = 1.1) -> None:
        rng, self.case = np.random.default_rng(4), Case(name)
        self.rasteriser = gpu.GpuRasteriser(self.case.camera, device=device)
        self.fit = DeviceDescent(copy.deepcopy(self.case.splats), 0.9, 0.99, 1)
        case, self.mosaic = self.case, Mosaic.GRBG if name == "mosaic" else None
        self.poses = case.rotations, case.centres
        self.image = self.rasteriser.forward_moving(
            case.splats, *self.poses, case.windows, channels=case.channels, background=BACKGROUND
        ).values
        size = self.image.shape
        self.gain = np.exp(0.05 * rng.normal(size=size)).astype(np.float32) if self.image.ndim == 2 else None
        self.level = level
        deviation = rng.uniform(0, 0.1, size).astype(np.float32)
        deviation[rng.random(size) < 0.1] = np.inf
        noise = rng.normal(0, 0.05, size) * np.minimum(deviation, 0.1) / 0.05
        bright = 1.0 if self.gain is None else self.gain * np.float32(level)
        self.target = Target((bright * self.image + noise).astype(np.float32), deviation, case.windows)
        self.frame = self.rasteriser.frame(self.target.values, deviation, case.windows, case.channels)
        self.loss = RateLoss(ssim, floor)
        self.terms = RateTerms(WHITE, floor, ssim, self.loss.ssim_scale)

    @property
    def scene(self) -> DeviceScene:
        return self.fit.on_device(self.rasteriser)

    @property
    def gains(self) -> ViewGains | None:
        return None if self.gain is None else ViewGains(self.gain, self.level, MODEL_ERROR, AGREEING_SIGMAS)

    def compare(self) -> Compared:
        return self.rasteriser.compare(self.scene, *self.poses, self.frame, self.terms, self.gains, BACKGROUND)

    def expected(self) -> tuple[float, float, Floats]:
        """Error, value and slope of the CPU for the device's image."""
        factor = np.float32(1) if self.gain is None else np.asarray(self.gain * np.float32(self.level), np.float32)
        made = self.loss.compare(self.image * factor, self.target, WHITE, self.mosaic)
        return made.error, made.value, made.slope * factor


@on_devices
@pytest.mark.parametrize("name", ["one", "three colours", "mosaic"])
@pytest.mark.parametrize("ssim", [0.0, 0.2, 1.0])
def test_values_and_slopes_are_those_of_the_cpu(device: str, name: str, ssim: float) -> None:
    pair = Pair(device, name, ssim)
    made, (error, value, slope) = pair.compare(), pair.expected()
    assert made.error == pytest.approx(error, rel=1e-5)
    assert (1 - ssim) * made.error + ssim * pair.loss.ssim_scale * made.unlike == pytest.approx(value, rel=1e-5)
    assert relative(pair.rasteriser.slope(slope.shape), slope) < 2e-5
    if pair.gain is None:
        assert (made.expected_light, made.seen_light) == (0, 0)
    else:
        image, view = (pair.gain, pair.image), (pair.target.values, pair.target.deviation)
        light = agreement(*image, *view, MODEL_ERROR, AGREEING_SIGMAS)
        assert (made.expected_light, made.seen_light) == pytest.approx(light, rel=1e-5)
        assert 0.5 < made.seen_light / pair.target.values.sum() < 0.95


@on_devices
@pytest.mark.parametrize("size", [(1, 1), (3, 2), (17, 33), (64, 48)])
@pytest.mark.parametrize("mosaic", [False, True], ids=["grey", "mosaic"])
def test_images_of_any_size(device: str, size: tuple[int, int], mosaic: bool) -> None:
    """Smaller than the window of SSIM, and than a tile; and of a camera that stands still."""
    width, height = size
    camera = Camera(Intrinsics(40.0, 40.0, width / 2, height / 2), width, height)
    splats, rasteriser = scenes.splats(60, 3 if mosaic else 1, 2), gpu.GpuRasteriser(camera, device=device)
    pattern = Mosaic.RGGB if mosaic else None
    channels = None if pattern is None else pattern.channels(height, width)
    poses = np.eye(3)[None], np.zeros((1, 3))
    image = rasteriser.forward(splats, *poses, channels=channels).values
    rng = np.random.default_rng(1)
    values, deviation = rng.uniform(0, 0.6, (2, height, width)).astype(np.float32)
    scene = DeviceDescent(splats, 0.9, 0.99, 1).on_device(rasteriser)
    made = rasteriser.compare(
        scene, *poses, rasteriser.frame(values, deviation, None, channels), RateTerms(WHITE, 0.03, 0.5, 1.0)
    )
    wanted = RateLoss(0.5, 0.03, 1.0).compare(image, Target(values, deviation, None), WHITE, pattern)
    assert 0.5 * made.error + 0.5 * made.unlike == pytest.approx(wanted.value, rel=1e-5)
    assert relative(rasteriser.slope(image.shape), wanted.slope) < 2e-5


@on_devices
def test_a_step_is_one_along_the_slope(device: str) -> None:
    """Without the slope's way to main memory and back the splats are the same to the bit, also a second time."""
    rates, limits, axes = (2e-2, 2e-3, 3e-3, 4e-2, 5e-3), SizeLimits(float(np.log(0.1))), MeanAxes(0.01, own=True)
    made: list[Scene] = []
    for through_memory in (False, True, False):
        pair = Pair(device, "three colours")
        for _ in range(3):
            pair.compare()
            slope = pair.rasteriser.slope(pair.image.shape)
            if through_memory:
                pair.rasteriser.forward_moving(pair.scene, *pair.poses, pair.case.windows, background=BACKGROUND)
            pair.fit.step(pair.rasteriser, slope if through_memory else None, rates, limits, axes)
        made.append(pair.fit.scene)
    for first, *others in zip(*(one.arrays() for one in made), strict=True):
        assert all(np.array_equal(first, other) for other in others)
    assert np.abs(made[0].means - Case("three colours").splats.means).max() > 1e-3


@on_devices
def test_evidence_of_gains_is_added_to_what_there_was(device: str) -> None:
    pair = Pair(device, "mosaic")
    assert pair.gain is not None
    xx, xy = np.ones((2, *pair.image.shape), np.float32)
    view = pair.target.values, pair.target.deviation
    pair.rasteriser.set_evidence(xx, xy)
    for level in (1.1, 0.9):
        pair.compare()
        pair.rasteriser.add_evidence(level, MODEL_ERROR)
        gain_evidence(pair.gain, pair.image, *view, level, MODEL_ERROR, xx, xy)
    made = pair.rasteriser.evidence()
    assert relative(made[0], xx) < 1e-6 and relative(made[1], xy) < 1e-5 and made[0].min() >= 1


@on_devices
def test_a_checkpoint_changes_no_bit_of_the_gains(device: str) -> None:
    """Evidence that was fetched in between is added up in the same order."""
    made: list[Floats] = []
    for checkpoints in (False, True):
        pair = Pair(device, "mosaic")
        nuisances = Nuisances(*pair.image.shape)
        for level in (1.1, 0.9, 1.3):
            pair.compare()
            nuisances.expect(pair.rasteriser)
            pair.rasteriser.add_evidence(level, MODEL_ERROR)
            if checkpoints:
                nuisances = pickle.loads(pickle.dumps(nuisances))
        made.append(pickle.loads(pickle.dumps(nuisances)).__dict__["_xx"])
    assert np.array_equal(*made) and made[0].any()


@on_devices
def test_a_refused_view_leaves_the_last_one(device: str) -> None:
    pair, other = Pair(device, "one"), Pair(device, "one", level=2.0)
    xx, xy = np.zeros((2, *pair.image.shape), np.float32)
    made: list[Floats] = []
    for refused in (False, True):
        pair.compare()
        if refused:
            with pytest.raises(ConfigurationError, match="white"):
                pair.rasteriser.compare(pair.scene, *pair.poses, other.frame, replace(pair.terms, white=0.0))
        pair.rasteriser.set_evidence(xx, xy)
        pair.rasteriser.add_evidence(1.1, MODEL_ERROR)
        made.append(pair.rasteriser.evidence()[1])
    assert np.array_equal(*made) and made[0].any()


@on_devices
def test_other_gains_are_copied_to_the_device(device: str) -> None:
    pair = Pair(device, "one")
    before = pair.compare().error
    pair.gain = pair.gain * np.float32(1.5)
    assert pair.compare().error > 1.5 * before
    assert pair.compare().error == pytest.approx(pair.expected()[0], rel=1e-5)


@on_devices
def test_what_does_not_fit_is_told(device: str) -> None:
    pair, other = Pair(device, "one"), Pair(device, "three colours")
    rasteriser, scene, poses, terms = pair.rasteriser, pair.scene, pair.poses, pair.terms
    with pytest.raises(ConfigurationError, match="not compared"):
        pair.fit.step(rasteriser, None, (0.0,) * 5, SizeLimits(), MeanAxes())
    with pytest.raises(ConfigurationError, match="not compared"):
        rasteriser.slope(pair.image.shape)
    with pytest.raises(ConfigurationError, match="not compared"):
        rasteriser.add_evidence(1.0, MODEL_ERROR)
    with pytest.raises(ConfigurationError, match="other colours"):
        rasteriser.compare(scene, *poses, other.frame, terms)
    with pytest.raises(ConfigurationError, match="two poses"):
        rasteriser.compare(scene, poses[0][:1], poses[1][:1], pair.frame, terms)
    with pytest.raises(ConfigurationError, match="not finite"):
        rasteriser.compare(scene, poses[0] * np.nan, poses[1], pair.frame, terms)
    with pytest.raises(ConfigurationError, match="another size"):
        rasteriser.compare(scene, *poses, pair.frame, terms, ViewGains(np.ones((2, 2), np.float32), 1.0, 0.1, 3.0))
    with pytest.raises(ConfigurationError, match="one value a pixel"):
        gains = ViewGains(np.ones(other.image.shape[:2], np.float32), 1.0, 0.1, 3.0)
        other.rasteriser.compare(other.scene, *poses, other.frame, terms, gains)
    with pytest.raises(ConfigurationError, match="white"):
        rasteriser.compare(scene, *poses, pair.frame, replace(terms, white=0.0))
    size = pair.image.shape
    for windows, channels in (
        (pair.case.windows[:1], None),
        (pair.case.windows * np.float32(np.nan), None),
        (None, np.zeros((2, 2), np.uint8)),
        (None, np.full(size, 3, np.uint8)),
    ):
        with pytest.raises(ConfigurationError, match=r"windows are|not finite|mosaic"):
            rasteriser.frame(pair.target.values, pair.target.deviation, windows, channels)
    with pytest.raises(ConfigurationError, match="do not fit"):
        rasteriser.frame(pair.target.values[1:], pair.target.deviation, None)
    small = gpu.GpuRasteriser(scenes.camera(16, 16), device=device)
    with pytest.raises(ConfigurationError, match="another size"):
        small.compare(scene, *poses, pair.frame, terms)
    pair.compare()
    with pytest.raises(ConfigurationError, match="no evidence"):
        rasteriser.add_evidence(1.0, MODEL_ERROR)
    with pytest.raises(ConfigurationError, match="no evidence"):
        rasteriser.evidence()
    with pytest.raises(ConfigurationError, match="there was none"):
        rasteriser.backward(pair.image)


def test_views_on_a_device_make_room_for_others() -> None:
    made: list[int] = []

    def frame(key: int, nbytes: int = 10) -> Callable[[], DeviceFrame]:
        def make() -> DeviceFrame:
            made.append(key)
            return DeviceFrame(key, nbytes)

        return make

    cache = FrameCache(30)
    for key in (1, 2, 3, 1, 4, 1, 2):
        assert cache.get(key, frame(key)).native == key
    assert made == [1, 2, 3, 4, 2] and cache.nbytes == 30
    cache.get(5, frame(5, 100))
    assert len(cache) == 1


def test_views_make_room_where_a_device_lacks_memory() -> None:
    room = 3

    def make() -> DeviceFrame:
        if len(cache) >= room:
            raise ConfigurationError("out of memory")
        return DeviceFrame(None, 1)

    cache = FrameCache[DeviceFrame](100)
    for key in range(room + 1):
        cache.get(key, make)
    assert len(cache) == 1
    room = 0
    with pytest.raises(ConfigurationError, match="out of memory"):
        FrameCache[DeviceFrame](100).get(1, make)


def test_pending_evidence_is_part_of_a_checkpoint() -> None:
    class Elsewhere:
        def set_evidence(self, xx: Floats, xy: Floats) -> None:
            self.sums = xx + 1, xy + 0.5

        def evidence(self) -> tuple[Floats, Floats]:
            return self.sums

    nuisances = Nuisances(4, 6)
    nuisances.note(1, 1.0)
    nuisances.expect(Elsewhere())
    back = pickle.loads(pickle.dumps(nuisances))
    assert (back._xx == 1).all() and (back._xy == 0.5).all() and back._elsewhere is None
    nuisances.expect(Elsewhere())
    nuisances.expect(Elsewhere())  # of another map: what the first one has is taken
    assert (nuisances._xx == 2).all()
    nuisances.forget_views()
    assert not nuisances._xx.any() and nuisances._elsewhere is None


@pytest.fixture
def emulated(monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], None]:
    """Sets whether maps are fitted by the emulated kernels or by the CPU."""
    return lambda wanted: monkeypatch.setenv("SPIKED_RENDER", "emulated" if wanted else "cpu")


def test_the_emulation_can_be_asked_for(emulated: Callable[[bool], None]) -> None:
    emulated(True)
    assert isinstance(rasteriser_for(scenes.camera()), gpu.GpuRasteriser)
    assert choice.chosen().renderer == "emulated"


FRAMES = 160


def reconstructed(mosaic: Mosaic | None, steps: int, loss: LossName = LossName.CHARGE) -> Reconstructor:
    """A short recording of the built-in room, by the poses that it was made with."""
    sensor = Sensor(136, 97, 20_000.0, mosaic=mosaic, intrinsics=Intrinsics.from_fov(136, 97, 60))
    camera = SimulatedCamera(sensor)
    rotations, centres = camera.truth(np.arange(FRAMES))
    path = Trajectory((np.arange(FRAMES) + 0.5) / 20_000, rotations, centres)
    made = Reconstructor(
        sensor, Options(steps=steps, poses=path, window_frames=16, threads=1, mapping=MapOptions(loss=loss))
    )
    made.feed(0, camera.next_frames(FRAMES))
    made.finish()
    return made


@pytest.mark.parametrize("mosaic", [None, Mosaic.RGGB], ids=["grey", "mosaic"])
def test_a_reconstruction_on_the_device_is_that_of_the_cpu(
    mosaic: Mosaic | None, monkeypatch: pytest.MonkeyPatch, emulated: Callable[[bool], None]
) -> None:
    """Rates, gains of pixels and brightness of views are fitted; steps bring no image here."""
    for name, steps in (("NUISANCES_FROM", 5), ("GAINS_FROM", 10), ("NUISANCE_STEPS", 20)):
        monkeypatch.setattr(mapping, name, steps)
    came: list[str] = []
    show = gpu.GpuRasteriser._forward
    monkeypatch.setattr(gpu.GpuRasteriser, "_forward", lambda *given: came.append("image") or show(*given))
    made = []
    for wanted in (True, False):
        emulated(wanted)
        made.append(reconstructed(mosaic, 60))
    ours, theirs = (one.trainer.mapper for one in made)
    assert ours.steps == theirs.steps == 60
    assert 0 < len(came) < 50  # of seeds, densification and alignments
    pose = np.eye(3), np.zeros(3)
    pictures = [one.render(*pose) for one in (ours, theirs)]
    assert np.abs(pictures[0] - pictures[1]).mean() < 0.01 * theirs.white
    assert ours.loss == pytest.approx(theirs.loss, rel=0.2)
    gains = [one.nuisances.gain - 1 for one in (ours, theirs)]
    assert gains[0].std() > 0 and np.corrcoef(gains[0].ravel(), gains[1].ravel())[0, 1] > 0.95
    again = pickle.loads(pickle.dumps(ours))
    assert again.loss == ours.loss and np.array_equal(again.scene.means, ours.scene.means)


def test_another_loss_is_compared_by_the_cpu(emulated: Callable[[bool], None]) -> None:
    made = []
    for wanted in (True, False):
        emulated(wanted)
        made.append(reconstructed(None, 30, LossName.INTERVAL).trainer.mapper)
    assert isinstance(made[0].map_steps, DeviceMapSteps) and not made[0].map_steps._frames
    assert made[0].loss == pytest.approx(made[1].loss, rel=0.2)


def test_a_view_is_compared_by_the_sub_frames_of_its_request(emulated: Callable[[bool], None]) -> None:
    """A view that is on the device once has other windows for other sub-frames."""
    emulated(True)
    trainer = reconstructed(None, 5).trainer
    mapper, path = trainer.mapper, trainer._fitted_path
    (view_id, *_), still = trainer.usable(path), Stride((0.0,) * 5, SizeLimits(), MeanAxes())
    errors = []
    for parts in (1, 3, 1, 0):
        trainer.planner.sub_frames = parts
        request, view = trainer.planner.request(trainer.shown(view_id), path), trainer.shown(view_id)
        step = RateStep(view_id, view, request, mapper.levels[0], mapper.view_loss, mapper.white, 0.0)
        errors.append(mapper.map_steps.fit_rates(step, mapper.descent, still))
        assert errors[-1] == pytest.approx(MapSteps().fit_rates(step, mapper.descent, still), rel=1e-5)
    assert errors[0] == errors[2] and len(set(errors)) == 3
