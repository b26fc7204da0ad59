"""Splats as SOG and compressed PLY: what others decode by the published formats is the scene."""

import io
import json
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from spiked.export import ExportOptions, ExportSource, find_kind
from spiked.export.compressed_ply import morton_order
from spiked.export.sog import encode
from spiked.pose import rotation_of
from spiked.scene import SH_C0, Scene

from ..test_spz import angles_deg, random_scene, sigmoid, splat_transform

WHITE = 0.4


def ordered(scene: Scene) -> Scene:
    return scene.select(morton_order(scene.means))


def test_sog_decodes_to_the_scene() -> None:
    """By the formulas of its specification."""
    scene = ordered(random_scene(3000))
    with zipfile.ZipFile(io.BytesIO(encode(scene, WHITE))) as archive:
        meta = json.loads(archive.read("meta.json"))

        def pixels(name: str) -> np.ndarray:
            image = Image.open(io.BytesIO(archive.read(name))).convert("RGBA")
            return np.asarray(image).reshape(-1, 4)[: meta["count"]].astype(float)

        level = pixels("means_l.webp") + 256 * pixels("means_u.webp")
        low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
        logs = low + (high - low) * level[:, :3] / 65535
        np.testing.assert_allclose(np.sign(logs) * np.expm1(np.abs(logs)), scene.means, atol=2e-3)
        scales = np.array(meta["scales"]["codebook"])[pixels("scales.webp")[:, :3].astype(int)]
        assert np.abs(scales - scene.log_scales).max() < 0.05
        shade = pixels("sh0.webp")
        colours = 0.5 + SH_C0 * np.array(meta["sh0"]["codebook"])[shade[:, :3].astype(int)]
        assert np.abs(colours * WHITE - scene.colours).max() < 0.005
        np.testing.assert_allclose(shade[:, 3] / 255, sigmoid(scene.opacity_logits), atol=0.5 / 255 + 1e-6)
        packed = pixels("quats.webp")
    parts = (packed[:, :3] / 255 - 0.5) * np.sqrt(2)
    quats = np.zeros((len(parts), 4))
    for row, (part, mode) in enumerate(zip(parts, packed[:, 3].astype(int) - 252, strict=True)):
        quats[row, np.delete(np.arange(4), mode)] = part
        quats[row, mode] = np.sqrt(max(0.0, 1 - (part**2).sum()))
    assert angles_deg(quats, scene.quats).max() < 1


def test_compressed_ply_decodes_to_the_scene(source: ExportSource, tmp_path: Path) -> None:
    scene = source.need_scene()
    find_kind("compressed-ply").write(source, tmp_path / "scene.ply", ExportOptions())
    ply = PlyData.read(str(tmp_path / "scene.ply"))
    chunk, vertex = ply["chunk"].data, ply["vertex"].data
    scene = ordered(scene)
    group = np.arange(len(scene)) // 256

    def between(name: str, share: np.ndarray) -> np.ndarray:
        low, high = chunk[f"min_{name}"][group], chunk[f"max_{name}"][group]
        return np.asarray(low + (high - low) * share)

    word = vertex["packed_position"].astype(np.int64)
    for number, (shift, bits) in enumerate(((21, 11), (11, 10), (0, 11))):
        share = (word >> shift & (1 << bits) - 1) / ((1 << bits) - 1)
        name = "xyz"[number]
        step = (chunk[f"max_{name}"] - chunk[f"min_{name}"]).max() / ((1 << bits) - 1)
        assert np.abs(between(name, share) - scene.means[:, number]).max() <= 0.51 * step + 1e-5
    colour = vertex["packed_color"].astype(np.int64)
    red = between("r", (colour >> 24) / 255) * source.white
    assert np.abs(red - scene.colours[:, 0]).max() < 0.51 / 255 * source.white
    np.testing.assert_allclose((colour & 255) / 255, sigmoid(scene.opacity_logits), atol=0.51 / 255)
    rotation = vertex["packed_rotation"].astype(np.int64)
    assert (rotation >> 30 == np.abs(scene.quats).argmax(1)).all()


@pytest.mark.parametrize("kind", ["sog", "compressed-ply"])
def test_splat_transform_reads_the_scene(tmp_path: Path, kind: str) -> None:
    command = splat_transform()
    scene = ordered(random_scene(2000))
    source = ExportSource(None, None, scene)  # type: ignore[arg-type]
    scene.white = WHITE
    file = tmp_path / f"ours{find_kind(kind).suffix}"
    find_kind(kind).write(source, file, ExportOptions())
    scene.write_ply(tmp_path / "scene.ply")
    for name in (file.name, "scene.ply"):
        subprocess.run([*command, str(tmp_path / name), str(tmp_path / f"{name}.back.ply")], check=True, timeout=60)
    theirs, same = (Scene.read_ply(tmp_path / f"{name}.back.ply") for name in (file.name, "scene.ply"))
    near = np.linalg.norm(theirs.means[:, None] - same.means[None], axis=2).argmin(1)
    assert np.abs(theirs.means - same.means[near]).max() < 0.02
    turned = rotation_of(theirs.quats.astype(float)) - rotation_of(same.quats[near].astype(float))
    assert np.median(np.abs(turned)) < 0.02
    assert np.median(np.abs(theirs.colours - same.colours[near])) < 0.01
