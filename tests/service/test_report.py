"""`spiked report`: one file without requests, its figures, hostile text, and a bundle that other programs read."""

import io
import json
import re
import shutil
import subprocess
import sys
import zipfile
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from PIL import Image
from spiked_service.cli.main import app
from spiked_service.results.map_folder import write_map
from spiked_service.results.report.figures import Figures
from typer.testing import CliRunner

from spiked.errors import SceneError, SpikedError
from spiked.recording import RecordingWriter, open_recording
from spiked.scene import Scene
from spiked.trajectory import Trajectory

from ..room_map import SENSOR, room_map, visitor

TAGS = {
    "html", "head", "meta", "title", "style", "body", "main", "header", "h1", "h2", "h3", "p", "span", "section", "dl",
    "div", "dt", "dd", "data", "small", "figure", "figcaption", "img", "svg", "g", "path", "polyline", "polygon",
    "rect", "circle", "text", "ul", "li", "i", "details", "summary", "table", "thead", "tbody", "tr", "th", "td",
    "footer", "code",
}  # fmt: skip
HOSTILE = "</title></style><script>fetch('https://evil.example')</script><img src=x onerror=\"alert(1)\">"


class Page(HTMLParser):
    """Elements of a report, and the figures beside their names."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text
        self.tags: set[str] = set()
        self.attributes: list[tuple[str, str]] = []
        self.figures: dict[str, list[float]] = {}
        self.said = ""
        self._name = ""
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        self._inside = tag
        if tag in ("dt", "th"):
            self._name = ""
        if tag == "data":
            self.figures.setdefault(self._name, []).append(float(dict(attrs)["value"] or "nan"))

    def handle_data(self, data: str) -> None:
        self.said += "" if self._inside == "style" else data
        if self._inside in ("dt", "th"):
            self._name += data


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["report", *map(str, arguments)])


def report_of(folder: Path, *arguments: str | Path) -> Page:
    done = run(folder, *arguments)
    assert done.exit_code == 0, (done.output, done.exception)
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def assert_alone(page: Page) -> None:
    """Nothing runs, and nothing is fetched."""
    assert page.tags <= TAGS
    assert [name for name, _ in page.attributes if name.startswith("on") or name in ("href", "srcset", "action")] == []
    assert all(value.startswith("data:image/webp;base64,") for name, value in page.attributes if name == "src")
    style = re.search(r"<style>(.*?)</style>", page.text, re.DOTALL)
    assert style and not re.search(r"url\(|@import|expression", style[1])
    assert "default-src 'none'" in page.text


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short reconstruction, beside its recording, with figures of an evaluation."""
    folder = tmp_path_factory.mktemp("travels")
    room = folder / "room"
    for words in (
        [
            "simulate",
            "-o",
            room,
            "--frames",
            "512",
            "--width",
            "160",
            "--height",
            "96",
            "--flow",
            "0.2",
            "--views",
            "2",
        ],
        ["reconstruct", room / "simulated.dat", "-o", folder / "desk", "--steps", "8"],
        ["evaluate", folder / "desk", "--recording", room / "simulated.dat", "--json", folder / "desk/evaluation.json"],
    ):
        done = subprocess.run(
            [sys.executable, "-m", "spiked_service", *map(str, words)], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    return folder / "desk"


def test_the_figures_are_those_of_the_files(result: Path) -> None:
    page = report_of(result)
    assert_alone(page)
    figures: dict[str, Any] = json.loads((result / "report.json").read_text())
    evaluation = json.loads((result / "evaluation.json").read_text())
    shown = page.figures
    assert shown["poses"] == [len(Trajectory.read_tum(result / "trajectory.tum"))]
    assert shown["splats"] == [figures["splats"]] == [len(Scene.read_ply(result / "scene.ply"))]
    assert shown["frames"] == [figures["frames"]] == [512]
    assert shown["work"] == [figures["seconds"]["total"]] == shown["total"]
    assert shown["focal length (given)"] == figures["focal_px"]
    assert shown["steps"] == [figures["options"]["steps"]] == [8]
    assert shown["cores"] == [figures["machine"]["cores"]] and figures["machine"]["processor"] in page.said
    assert (shown["ATE"], shown["PSNR"]) == ([evaluation["ate_percent"]], [evaluation["psnr_db"]])
    assert figures["versions"]["numpy"] in page.said and "simulated.dat" in page.said
    assert [name for name, value in page.attributes if name == "src"] == ["src"] * 8  # seen and rendered, four times
    assert "complete" in page.said and str(result.parent) not in page.text


def test_each_part_of_a_bundle_is_read_by_its_own_reader(result: Path, tmp_path: Path) -> None:
    done = run(result, "--zip", "-o", tmp_path / "desk.zip", "--with-recording")
    assert done.exit_code == 0, (done.output, done.exception)
    with zipfile.ZipFile(tmp_path / "desk.zip") as archive:
        assert archive.testzip() is None
        archive.extractall(tmp_path)
    folder = tmp_path / "desk"
    path = Trajectory.read_tum(result / "trajectory.tum")
    assert np.array_equal(Trajectory.read_tum(folder / "trajectory.tum").table(), path.table())
    kitti = np.loadtxt(folder / "trajectory.kitti.txt").reshape(-1, 3, 4)
    assert np.allclose(kitti, path.matrices()[:, :3], atol=1e-8)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert np.allclose([np.array(one["transform_matrix"])[:3, 3] for one in frames], path.centres)
    rows = [line.split() for line in (folder / "colmap/images.txt").read_text().splitlines() if line[:1].isdigit()]
    translations = -np.einsum("nji,nj->ni", path.rotations, path.centres)
    assert np.allclose([[float(cell) for cell in row[5:8]] for row in rows], translations, atol=1e-8)
    assert (folder / "colmap/cameras.txt").read_text().splitlines()[1].split()[1:4] == ["PINHOLE", "160", "96"]
    assert (folder / "scene.ply").read_bytes() == (result / "scene.ply").read_bytes()
    sizes = {Image.open(io.BytesIO(file.read_bytes())).size for file in (folder / "pictures").iterdir()}
    assert sizes == {(160, 96)}
    recording = open_recording(folder / "recording.dat")
    assert recording.frames == 512 and recording.sensor.intrinsics is not None
    assert_alone(Page((folder / "report.html").read_text(encoding="utf-8")))
    report = json.loads((folder / "report.json").read_text())
    assert report["splats"] == json.loads((result / "report.json").read_text())["splats"]
    assert all(str(result.parent) not in file.read_text() for file in folder.glob("*.json"))


def test_hostile_names_are_text(result: Path, tmp_path: Path) -> None:
    folder = tmp_path / "<script>alert(1)<"
    shutil.copytree(result, folder)
    report = json.loads((folder / "report.json").read_text())
    report["warnings"] = [HOSTILE]
    report["states"] = [{"time_s": 0.0, "state": HOSTILE, "reason": HOSTILE}]
    report["views"] = [{"time_s": time, "state": HOSTILE} for time in (0.0, 0.1)]
    report["versions"][HOSTILE] = HOSTILE
    report["options"][HOSTILE] = [HOSTILE, {HOSTILE: HOSTILE}]
    report["merged"] = {HOSTILE: {"maps": [{HOSTILE: HOSTILE}]}}
    report["machine"]["processor"] = report["recording"]["file"] = HOSTILE
    report["paths"] = [{"name": "../../../etc/passwd", "poses": 1}]
    (folder / "report.json").write_text(json.dumps(report))
    page = report_of(folder)
    assert_alone(page)
    assert page.said.count(HOSTILE) >= 7 and "<script>alert(1)<" in page.said
    assert run(folder, "--zip").exit_code == 0
    with zipfile.ZipFile(folder / "bundle.zip") as archive:
        assert all(name.startswith("_script_alert_1__/") and ".." not in name for name in archive.namelist())


def test_the_end_of_a_curve_is_the_figure(result: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(result, tmp_path / "curve"))
    report = json.loads((folder / "report.json").read_text())
    report["psnr_of_views_over_seconds"] = [[1.5, 20.25], [2.5, 27.125], [4.0, 31.0625]]
    (folder / "report.json").write_text(json.dumps(report))
    page = report_of(folder)
    assert page.figures["PSNR of the views"] == [31.0625] and 'aria-label="PSNR of the mapped views"' in page.text


def test_a_report_that_is_none_is_told(result: Path, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"at views\.0\.time_s"):
        Figures.read({"views": [{"time_s": "soon", "state": "track"}]}, "report.json")
    for make, words in (
        (lambda: None, r"has no report\.json"),
        (lambda: (tmp_path / "report.json").write_text("[]"), "holds no JSON object"),
        (lambda: (tmp_path / "report.json").write_text("{"), "cannot be read"),
    ):
        make()
        assert re.search(words, str(run(tmp_path).exception))
    assert isinstance(run(result, "--recording", tmp_path / "gone.dat").exception, SpikedError)


def test_an_interrupted_run_is_said_to_be_one(result: Path, tmp_path: Path) -> None:
    """Ctrl-C leaves results and a checkpoint; SIGKILL a checkpoint alone."""
    program = (
        "import os, signal, sys\nfrom spiked.recon import checkpoint\nfrom spiked_service.cli.main import main\n"
        "save = checkpoint.CheckpointSaver.save\n"
        "def killed(self, reconstructor, now=False):\n"
        "    save(self, reconstructor, now=True)\n"
        "    if reconstructor.tracking_ended: os.kill(os.getpid(), signal.SIGKILL)\n"
        "checkpoint.CheckpointSaver.save = killed\nmain()\n"
    )
    recording, out = result.parent / "room/simulated.dat", tmp_path / "cut"
    words = ["reconstruct", str(recording), "-o", str(out), "--steps", "8"]
    subprocess.run([sys.executable, "-c", program, *words], capture_output=True, check=False)
    assert sorted(file.name for file in out.iterdir()) == ["checkpoint"]
    page = report_of(out)
    assert "incomplete" in page.said and "512 frames" in page.said and page.figures["poses"] == [512]
    assert sorted(file.name for file in out.iterdir()) == ["checkpoint", "report.html"]
    for name in ("report.json", "trajectory.tum", "scene.ply"):
        shutil.copy(result / name, out)  # of a run before: what is shown is the one that was interrupted
    page = report_of(out)
    assert "spiked reconstruct --resume completes it" in page.said
    assert page.figures["poses"] == [512] and page.figures["splats"] != report_of(result).figures["splats"]


def test_maps_of_several_recordings_and_localisations(tmp_path: Path) -> None:
    left, right = room_map(2, (0.0, 0.5)), room_map(2, (0.45, 0.95))
    left.write(tmp_path / "left")
    camera = json.loads((tmp_path / "left/report.json").read_text())
    figures = {"maps": [{"folder": str(tmp_path / "left")}], "similarity": {"scale": 1.0025}}
    paths = {"left": left.path, "right": right.path}
    write_map(tmp_path / "both", left.scene.join(right.scene), left.path, paths, {**camera, "merged": figures})
    page = report_of(tmp_path / "both")
    assert_alone(page)
    assert page.figures["similarity: scale"] == [1.0025] and str(tmp_path) not in page.text
    assert run(tmp_path / "both", "--zip").exit_code == 0
    with zipfile.ZipFile(tmp_path / "both/bundle.zip") as archive:
        assert {"both/paths/left.tum", "both/paths/right.tum"} <= set(archive.namelist())
    with RecordingWriter(tmp_path / "again.dat", SENSOR) as writer:
        writer.append(visitor(2).next_frames(200))
    words = ["localise", str(tmp_path / "left"), str(tmp_path / "again.dat"), "-o", str(tmp_path / "where")]
    assert CliRunner().invoke(app, words).exit_code == 0
    page = report_of(tmp_path / "where")
    found = json.loads((tmp_path / "where/localisation.json").read_text())
    assert page.figures["poses"] == [len(found["localisation"]["views"])]
    assert found["localisation"]["reason"] in page.said
