"""Every format says the unit of its lengths, how certain it is and which way is up, where it has a place for that."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
import yaml
from mcap.reader import make_reader
from plyfile import PlyData
from rerun.chunk import RrdReader

from spiked.export import ExportOptions, ExportSource, find_kind
from spiked.frame_of_reference import FrameOfReference, KnownScale
from spiked.trajectory import Trajectory

OPTIONS = ExportOptions(views=6, resolution=48)
UP = (0.0, 0.0, 1.0)
OWN = {"unit": "scene", "metres_per_unit": 2.5, "scale_sigma": 0.004, "up": [0.0, 0.0, 1.0]}
METRIC = {"unit": "m", "metres_per_unit": 1.0, "scale_sigma": 0.004, "up": [0.0, -1.0, 0.0]}


@pytest.fixture(scope="module", params=["own", "metric"])
def case(source: ExportSource, request: pytest.FixtureRequest) -> tuple[ExportSource, dict[str, Any]]:
    """A result whose scale is known, in its own unit or in metres, and what its files are to say."""
    known = replace(source, scale=KnownScale("scene", 2.5, 0.004, UP))
    if request.param == "own":
        return known, OWN
    return known.in_frame(FrameOfReference(2.5, UP)), METRIC


def written(case: tuple[ExportSource, dict[str, Any]], kind: str, folder: Path) -> Path:
    path = folder / f"made{find_kind(kind).suffix}"
    find_kind(kind).write(case[0], path, OPTIONS)
    return path


def of_notes(lines: list[str]) -> dict[str, Any]:
    """The values in comments."""
    found: dict[str, Any] = {}
    for line in lines:
        name, *values = line.split()
        if name in OWN:
            numbers = [] if name == "unit" else [float(value) for value in values]
            found[name] = values[0] if name == "unit" else numbers if name == "up" else numbers[0]
    return found


@pytest.mark.parametrize("kind", ["ply", "compressed-ply", "points-ply", "mesh-ply"])
def test_comments_of_ply(case: tuple[ExportSource, dict[str, Any]], tmp_path: Path, kind: str) -> None:
    ply = PlyData.read(str(written(case, kind, tmp_path)))
    assert of_notes(ply.comments) == case[1]
    assert len(ply["vertex"].data) > 0


def test_comments_of_pcd(case: tuple[ExportSource, dict[str, Any]], tmp_path: Path) -> None:
    head = written(case, "points-pcd", tmp_path).read_bytes().split(b"DATA binary\n")[0].decode().splitlines()
    assert head[0].startswith("# .PCD v0.7")
    assert of_notes([line[2:] for line in head if line.startswith("# ")]) == case[1]


def test_extras_of_gltf(case: tuple[ExportSource, dict[str, Any]], tmp_path: Path) -> None:
    path = written(case, "mesh-glb", tmp_path)
    content = path.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    assert json.loads(content[20 : 20 + length])["asset"]["extras"] == case[1]
    assert len(trimesh.load(path, force="mesh").faces) > 0


def test_json_of_folders_and_archives(case: tuple[ExportSource, dict[str, Any]], tmp_path: Path) -> None:
    for kind, file in (("depth", "depth.json"), ("nerfstudio", "transforms.json")):
        assert json.loads((written(case, kind, tmp_path / kind) / file).read_text())["scale"] == case[1]
    assert of_notes(PlyData.read(str(tmp_path / "nerfstudio" / "made" / "sparse.ply")).comments) == case[1]
    assert json.loads((written(case, "colmap", tmp_path / "colmap") / "scale.json").read_text()) == case[1]
    with zipfile.ZipFile(written(case, "sog", tmp_path)) as archive:
        asset = json.loads(archive.read("meta.json"))["asset"]
    assert asset == {"generator": "spiked", **case[1]}


def test_metadata_of_recordings_with_time(case: tuple[ExportSource, dict[str, Any]], tmp_path: Path) -> None:
    with written(case, "mcap", tmp_path).open("rb") as file:
        (metadata,) = (one for one in make_reader(file).iter_metadata() if one.name == "scale")
    assert of_notes([f"{name} {text}" for name, text in metadata.metadata.items()]) == case[1]
    bag = yaml.safe_load((written(case, "ros-bag", tmp_path) / "metadata.yaml").read_text())
    said = bag["rosbag2_bagfile_information"]["custom_data"]
    assert of_notes([f"{name} {text}" for name, text in said.items()]) == case[1]
    with h5py.File(written(case, "nexus", tmp_path)) as nexus:
        group = nexus["entry/scale"].attrs
        assert {name: group[name].tolist() if name == "up" else group[name] for name in OWN} == case[1]


def test_components_of_rerun(case: tuple[ExportSource, dict[str, Any]], tmp_path: Path) -> None:
    found: dict[str, Any] = {}
    for chunk in RrdReader(written(case, "rerun", tmp_path)).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/world":
            found |= {name: batch.column(name).to_pylist()[0] for name in batch.schema.names if name in OWN}
    assert {name: value if name == "up" else value[0] for name, value in found.items()} == case[1]


def test_an_unknown_scale_is_not_claimed(source: ExportSource, tmp_path: Path) -> None:
    find_kind("ply").write(source, tmp_path / "a.ply", OPTIONS)
    assert of_notes(PlyData.read(str(tmp_path / "a.ply")).comments) == {}
    assert KnownScale().known == {"unit": "scene"}


def test_comments_of_a_path_are_skipped_by_readers(source: ExportSource, tmp_path: Path) -> None:
    source.path.write_tum(tmp_path / "a.tum", KnownScale("m", 1.0, 0.01, (0.0, -1.0, 0.0)).notes)
    assert "# scale_sigma 0.01\n" in (tmp_path / "a.tum").read_text()
    np.testing.assert_allclose(Trajectory.read_tum(tmp_path / "a.tum").centres, source.path.centres, atol=1e-8)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "a.tum")[:, 1:4], source.path.centres, atol=1e-8)
