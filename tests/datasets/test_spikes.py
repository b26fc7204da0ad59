"""Every layout of spikes gives the frames that were written into it, and so the same trajectory."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from spiked_service.results.recording_feed import reconstruct_recording

from spiked.calibration import Calibration
from spiked.datasets import Clip, Dataset, find_kind, recognise
from spiked.recon import Options, Reconstructor
from spiked.recording import RecordingWriter, open_recording
from spiked.sensor import Mosaic, Response, Sensor

from .layouts import LAYOUTS, Source, numbered, usp_gaussian, wision

References = dict[tuple[int, tuple[int, int]], str]


@pytest.fixture(scope="session")
def references() -> References:
    return {}


def reconstructed(recording: Path, source: Source) -> str:
    """The trajectory of a recording, as the text of a TUM file; optics are given where it has none."""
    opened = open_recording(recording)
    sensor = opened.sensor
    if sensor.intrinsics is None:
        sensor = replace(sensor, intrinsics=source.intrinsics)
    # All layouts are of the same spikes: rates that are stated or assumed otherwise would only scale the times.
    # The spikes are not those of a single-photon camera, whatever a layout is usually of.
    sensor = replace(sensor, frame_rate_hz=20_000.0, response=Response.INTEGRATE_AND_FIRE)
    reconstructor = Reconstructor(sensor, Options(steps=0, threads=2), recording=opened)
    reconstruct_recording(opened, reconstructor, progress=lambda status: None, cancelled=lambda: False)
    assert reconstructor.failure is None
    return reconstructor.trajectory().tum()


def as_itself(source: Source, folder: Path) -> Path:
    """The frames in a recording of our own."""
    sensor = Sensor(*source.size, 20_000.0, intrinsics=source.intrinsics)
    with RecordingWriter(folder / "itself.dat", sensor) as writer:
        writer.append(np.frombuffer(source.dat(), np.uint8).reshape(len(source.pixels), -1))
    return folder / "itself.dat"


def opened(layout: str, source: Source, folder: Path) -> Dataset:
    name, write, _ = LAYOUTS[layout]
    folder.mkdir()
    write(folder, source)
    assert recognise(folder)[0].name == name
    return find_kind(name).open(folder)


def only_clip(dataset: Dataset) -> Clip:
    (clip,) = dataset.items
    assert isinstance(clip, Clip)
    return clip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_gives_the_same_trajectory_as_the_recording_itself(
    layout: str, source: Source, references: References, tmp_path: Path
) -> None:
    clip = only_clip(opened(layout, source, tmp_path / "set"))
    held = LAYOUTS[layout][2](source)
    recording = clip.write(tmp_path / "made", layout)
    np.testing.assert_array_equal(open_recording(recording).images(0, clip.frames), held.pixels)
    if held is not source:
        return  # of a larger sensor: the other form of the set is reconstructed
    key = (id(source), held.size)
    if key not in references:
        references[key] = reconstructed(as_itself(source, tmp_path), source)
    assert reconstructed(recording, source) == references[key]


def test_a_recording_is_not_copied(source: Source, tmp_path: Path) -> None:
    clip = only_clip(opened("spikecv", source, tmp_path / "set"))
    recording = clip.write(tmp_path / "made", "spikecv")
    assert recording.is_symlink() and recording.resolve() == (tmp_path / "set" / "scene" / "spike.dat").resolve()
    assert open_recording(recording).questions == ()
    assert set(open_recording(recording).assumed) == {"frame_rate", "bit_order"}


def test_poses_of_clips_come_at_their_middles(source: Source, tmp_path: Path) -> None:
    clip = only_clip(opened("usp-gaussian", source, tmp_path / "set"))
    path = clip.truth.path
    assert path is not None
    frames = np.round(path.times_s * 20_000 - 0.5).astype(int)
    np.testing.assert_array_equal(frames, [50, 110, len(source.pixels) - 50])
    np.testing.assert_allclose(path.matrices(), source.poses(frames), atol=1e-12)


@pytest.mark.parametrize("layout", ["spikegs-real", "spikegs-synthetic"])
def test_poses_of_spikegs_come_at_the_frames_of_their_names(layout: str, source: Source, tmp_path: Path) -> None:
    clip = only_clip(opened(layout, source, tmp_path / "set"))
    frames = numbered(source)
    assert clip.truth.path is not None and clip.sensor.intrinsics is not None
    np.testing.assert_allclose(clip.truth.path.times_s, (frames + 0.5) / 20_000)
    np.testing.assert_allclose(clip.truth.path.matrices(), source.poses(frames), atol=1e-9)
    assert clip.sensor.intrinsics.fx == pytest.approx(source.intrinsics.fx, rel=1e-12)
    views = clip.truth.views
    if layout == "spikegs-synthetic":
        assert [view.file.name for view in views] == [f"r_{frame}.png" for frame in frames[1::2]]
        np.testing.assert_allclose([view.pose for view in views], source.poses(frames[1::2]), atol=1e-9)
    else:
        assert not views and clip.truth.median_depth is not None


def test_synthetic_clips_are_joined_by_their_numbers(source: Source, tmp_path: Path) -> None:
    scene = tmp_path / "wine"
    (scene / "spike_data").mkdir(parents=True)
    frames = 8 * 4 + 73
    for index in range(3):
        part = source.pixels[index * 32 : index * 32 + frames].copy()
        part[:, index, index] ^= 1  # simulated by itself: no frame is that of the neighbour
        clip = Source(part, source.intrinsics, source.path)
        (scene / "spike_data" / f"{19 + 4 * index:06d}.dat").write_bytes(clip.dat())
    clip = only_clip(find_kind("usp-gaussian").open(scene))
    assert clip.frames == 2 * 32 + frames and "jump every" in clip.notes[0]
    pixels = open_recording(clip.write(tmp_path / "made", "x")).images(0, clip.frames)
    assert (pixels != source.pixels[: clip.frames]).sum() == clip.frames
    (scene / "spike_data" / "000023.dat").unlink()
    with pytest.raises(Exception, match="the clip after 000019 is missing"):
        find_kind("usp-gaussian").open(scene)


def test_hot_pixels_are_left_out(source: Source, tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    wision(tmp_path / "set", source)
    masks = np.zeros((2, *source.pixels.shape[1:]), bool)
    masks[0, 3, 7] = masks[1, 100, 200] = True
    np.save(tmp_path / "set" / "hot_pixel_mask.npy", masks[0])
    np.save(tmp_path / "set" / "binary" / "dead.npy", masks[1].astype(np.uint8))
    clip = only_clip(find_kind("wision").open(tmp_path / "set"))
    recording = clip.write(tmp_path / "made", "wision")
    np.testing.assert_array_equal(Calibration.read(recording.parent / "calibration.npz").dead, masks.any(0))
    assert clip.sensor.response is Response.BERNOULLI and clip.sensor.frame_rate_hz == 20_000


@pytest.mark.parametrize(
    ("name", "masks"),
    [("photoncube", False), ("shot1", False), ("hot_pixels", True), ("spad_hotPixelMask", True), ("badmask", True)],
)
def test_a_mask_is_known_by_its_name(tmp_path: Path, name: str, masks: bool) -> None:
    np.save(tmp_path / f"{name}.npy", np.zeros((20, 256, 64), np.uint8))
    assert find_kind("wision").recognises(tmp_path) is not masks


def test_poses_are_those_of_clips_whose_names_are_not_padded(source: Source, tmp_path: Path) -> None:
    usp_gaussian(tmp_path / "set", source)
    scene = next(path.parent for path in tmp_path.rglob("transforms.json"))
    content = json.loads((scene / "transforms.json").read_text())
    before = find_kind("usp-gaussian").open(tmp_path / "set").items[0].truth.path
    assert before is not None and len(before) >= 3
    for number, frame in enumerate(sorted(content["frames"], key=lambda one: one["file_path"]), 9):
        frame["file_path"] = f"{number}.png"
    content["frames"].reverse()
    (scene / "transforms.json").write_text(json.dumps(content))
    after = find_kind("usp-gaussian").open(tmp_path / "set").items[0].truth.path
    np.testing.assert_array_equal(after.centres, before.centres)


def test_a_label_of_spikecv_states_the_mosaic(source: Source, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    dataset = opened("spikecv", source, folder)
    assert only_clip(dataset).sensor.mosaic is None
    config = folder / "config.yaml"
    config.write_text(config.read_text().replace("[0]", "[7]"))
    assert only_clip(find_kind("spikecv").open(folder)).sensor.mosaic is Mosaic.BGGR


def test_rows_that_end_within_a_byte_are_read(tmp_path: Path) -> None:
    pixels = np.random.default_rng(1).integers(0, 2, (9, 20, 30), np.uint8)
    (tmp_path / "config.yaml").write_text("spike_w: 30\nspike_h: 20\nlabeled_data_type: [0]\n")
    (tmp_path / "a.dat").write_bytes(np.packbits(pixels[:, ::-1].reshape(9, -1), axis=1, bitorder="little").tobytes())
    clip = only_clip(find_kind("spikecv").open(tmp_path))
    made = open_recording(clip.write(tmp_path / "made", "spikecv"))
    np.testing.assert_array_equal(made.images(0, 9), pixels[:, :, :24])


def test_a_real_recording_of_the_set_is_read(shared: Path, tmp_path: Path) -> None:
    (tmp_path / "classA").mkdir()
    (tmp_path / "classA" / "car-100kmh.dat").symlink_to(shared / "real" / "car_100kmh.dat")
    clip = only_clip(find_kind("recvidarreal").open(tmp_path))
    made = open_recording(clip.write(tmp_path / "made", "recvidarreal"))
    assert made.images(0, made.frames).sum(dtype=np.int64) == 7_324_316
