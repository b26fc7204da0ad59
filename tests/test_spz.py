"""SPZ scenes: what is written comes back within the bounds that the module states, and other tools agree."""

import gzip
import os
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

from spiked.errors import SceneError
from spiked.pose import rotation_of
from spiked.scene import Scene
from spiked.spz import SpzVersion, decode, encode, fractional_bits, position_step

WHITE = 0.4
COLOUR_BOUND = 0.0037 * WHITE + 1e-6


def random_scene(count: int, channels: int = 3, seed: int = 0) -> Scene:
    rng = np.random.default_rng(seed)
    return Scene(
        rng.normal(0, 3, (count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.uniform(-9, 1, (count, 3)).astype(np.float32),
        rng.uniform(-4, 4, count).astype(np.float32),
        rng.uniform(0, WHITE, (count, channels)).astype(np.float32),
    )


def sigmoid(logits: np.ndarray) -> np.ndarray:
    return np.asarray(1 / (1 + np.exp(-logits.astype(np.float64))))


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between the rotations of quaternions of any sign and length."""
    relative = rotation_of(a.astype(np.float64)) @ rotation_of(b.astype(np.float64)).swapaxes(-1, -2)
    return np.degrees(np.arccos(np.clip((np.trace(relative, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))


@pytest.mark.parametrize("version", list(SpzVersion))
@pytest.mark.parametrize("channels", [1, 3])
def test_a_round_trip_stays_within_the_stated_bounds(version: SpzVersion, channels: int) -> None:
    scene = random_scene(5000, channels)
    back = decode(encode(scene, WHITE, version), WHITE)
    assert back.colours.shape == scene.colours.shape
    np.testing.assert_allclose(back.means, scene.means, rtol=0, atol=position_step(scene) * 0.501)
    np.testing.assert_allclose(sigmoid(back.opacity_logits), sigmoid(scene.opacity_logits), atol=1 / 510 + 1e-6)
    np.testing.assert_allclose(back.log_scales, scene.log_scales, atol=1 / 32 + 1e-6)
    np.testing.assert_allclose(back.colours, scene.colours, atol=COLOUR_BOUND)
    if version is SpzVersion.V3:
        assert angles_deg(back.quats, scene.quats).max() < 0.3


def test_version_2_is_exact_for_small_turns_only() -> None:
    """w is the root of what x, y and z leave, so that their error counts 1 / w times."""
    scene = random_scene(5000)
    w = np.abs(scene.quats[:, 0]) / np.linalg.norm(scene.quats, axis=1)
    angles = angles_deg(decode(encode(scene, WHITE, SpzVersion.V2), WHITE).quats, scene.quats)
    assert (angles * w)[w > 0.1].max() < 0.8


@pytest.mark.parametrize("count", [0, 1])
def test_few_gaussians(count: int) -> None:
    assert len(decode(encode(random_scene(count)))) == count


def test_positions_use_the_bits_that_their_reach_leaves() -> None:
    assert fractional_bits(np.array([[0.5, 0, 0]], np.float32)) == 22
    for reach in (1.9999999, 2.0, 100.0, 4e6):
        far = random_scene(1)
        far.means[0] = [reach, -reach, 0]
        np.testing.assert_allclose(decode(encode(far)).means, far.means, atol=position_step(far) * 0.501)
    far.means[0, 0] = 1e7
    with pytest.raises(SceneError, match="use PLY"):
        encode(far)


def test_axes_are_rub_in_the_file() -> None:
    scene = random_scene(1)
    scene.means[0] = [1, 2, 3]
    body = gzip.decompress(encode(scene))
    raw = np.frombuffer(body, np.uint8, 9, 16).reshape(3, 3)
    fixed = [int.from_bytes(bytes(row), "little", signed=True) for row in raw]
    np.testing.assert_allclose(np.array(fixed) / 2.0 ** body[13], [1, -2, -3], atol=1e-5)


def test_other_bytes_are_refused() -> None:
    good = encode(random_scene(100))
    body = gzip.decompress(good)
    header = struct.Struct("<IIIBBBB")
    cases = {
        "not an SPZ scene": b"ply\n",
        "ends within its header": gzip.compress(b"NGSP"),
        "first bytes are not NGSP": gzip.compress(b"XXXX" + body[4:]),
        "version 7": gzip.compress(body[:4] + struct.pack("<I", 7) + body[8:] + bytes(4)),
        "cut short": gzip.compress(body[:-5]),
        "can be read: 4000000000 Gaussians": gzip.compress(header.pack(0x5053474E, 3, 4_000_000_000, 0, 12, 0, 0)),
    }
    for message, raw in cases.items():
        with pytest.raises(SceneError, match=message):
            decode(raw)
    for end in range(0, len(good) - 8, 97):  # without the eight bytes of gzip's own check, which is not needed
        with pytest.raises(SceneError):
            decode(good[:end])


def test_what_follows_the_announced_bytes_is_not_inflated() -> None:
    bomb = gzip.compress(gzip.decompress(encode(random_scene(2))) + bytes(50_000_000))
    assert len(decode(bomb)) == 2


def test_a_sample_is_fixed_and_spread_evenly() -> None:
    scene = random_scene(10_000)
    some = scene.sample(500)
    assert len(some) == 500
    rows = np.flatnonzero(np.isin(scene.means[:, 0], some.means[:, 0]))
    assert np.diff(rows).max() < 3 * 10_000 / 500
    grown = random_scene(500, seed=1).join(scene).select(np.arange(500, 10_500))
    np.testing.assert_array_equal(grown.sample(500).means, some.means)
    assert scene.sample(20_000) is scene


def splat_transform() -> list[str]:
    """@playcanvas/splat-transform as it is in web/package.json, or as named in SPIKED_SPLAT_TRANSFORM."""
    local = Path(__file__).parents[1] / "web" / "node_modules" / ".bin" / "splat-transform"
    if not shutil.which("node"):
        pytest.skip("needs node")
    found = Path(os.environ.get("SPIKED_SPLAT_TRANSFORM", local))
    assert found.exists(), f"{found} is missing: `make page` installs the packages of web/"
    return [str(found)]


@pytest.mark.parametrize("version", list(SpzVersion))
def test_splat_transform_reads_the_same_scene_from_our_spz_as_from_our_ply(version: SpzVersion, tmp_path: Path) -> None:
    command = splat_transform()
    scene = random_scene(300)
    (tmp_path / "ours.spz").write_bytes(encode(scene, WHITE, version))
    subprocess.run([*command, str(tmp_path / "ours.spz"), str(tmp_path / "theirs.ply")], check=True, timeout=60)
    theirs = Scene.read_ply(tmp_path / "theirs.ply")
    order = np.argsort(scene.means[:, 0]), np.argsort(theirs.means[:, 0])
    ours, theirs = scene.select(order[0]), theirs.select(order[1])
    np.testing.assert_allclose(theirs.means, ours.means, atol=position_step(scene) * 2)
    np.testing.assert_allclose(theirs.colours * WHITE, ours.colours, atol=2 * COLOUR_BOUND)
    np.testing.assert_allclose(theirs.log_scales, ours.log_scales, atol=1 / 16)
    assert np.median(angles_deg(theirs.quats, ours.quats)) < 0.7
