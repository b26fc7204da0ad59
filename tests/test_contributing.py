"""The how-tos of CONTRIBUTING.md: each is carried out in a copy of the repository, and its test is run there."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from .test_docs import dead_links

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
COPIED = ("spiked", "driver", "service", "tests", "docs", "deploy", "web/src", "pyproject.toml", "CMakeLists.txt")
STEP = re.compile(
    r"^\d+\. (?P<new>New file )?`(?P<file>[^`]+)`(?:, (?P<where>below|above|in place of) `(?P<anchor>[^\n]+)`)?:\n\n"
    r"   ```\w*\n(?P<code>.*?)^   ```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Step:
    """One change of one file."""

    file: str
    where: str | None
    """below, above, in place of; None: a new file."""
    anchor: str
    code: str

    def carry_out(self, copy: Path) -> None:
        path = copy / self.file
        if self.where is None:
            assert not path.exists(), f"{self.file} is not new"
            path.write_text(self.code, encoding="utf-8")
            return
        text = path.read_text(encoding="utf-8")
        if self.where == "in place of":
            assert text.count(self.anchor) == 1, f"{self.anchor!r} is not once in {self.file}"
            path.write_text(text.replace(self.anchor, self.code.rstrip("\n")), encoding="utf-8")
            return
        lines = text.splitlines(keepends=True)
        at = next((number for number, line in enumerate(lines) if self.anchor in line), None)
        assert at is not None, f"{self.anchor!r} is not in {self.file}"
        lines.insert(at + (self.where == "below"), self.code)
        path.write_text("".join(lines), encoding="utf-8")


def how_to(title: str) -> str:
    """The section below a heading."""
    (section,) = re.findall(rf"^### {title}\n(.*?)(?=^### |\Z)", TEXT, re.MULTILINE | re.DOTALL)
    return str(section)


def steps(section: str) -> Iterator[Step]:
    for found in STEP.finditer(section):
        code = re.sub(r"^ {3}", "", found["code"], flags=re.MULTILINE)  # the indentation of the list
        yield Step(found["file"], found["where"], found["anchor"] or "", code)


def python(copy: Path, *words: str, seconds: float = 300) -> str:
    """Output of Python in the copy, whose packages it takes. `-S`: no editable installation stands before them."""
    installed = [place for place in sys.path if "site-packages" in place]
    places = [str(copy), str(copy / "driver"), str(copy / "service"), *installed]
    done = subprocess.run(
        [sys.executable, "-S", *words], cwd=copy, env={**os.environ, "PYTHONPATH": os.pathsep.join(places)},
        capture_output=True, text=True, timeout=seconds, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """What is needed of the repository, to be changed."""
    unwanted = shutil.ignore_patterns("__pycache__", "page", "corpus", "*.webp", "*.png")
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tmp_path / name, ignore=unwanted)
        else:
            shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def carry_out(title: str, copy: Path) -> list[str]:
    """The new test files."""
    section = how_to(title)
    done = list(steps(section))
    assert len(done) == len(re.findall(r"^   ```\w+$", section, re.MULTILINE)), "a step is not understood"
    for step in done:
        step.carry_out(copy)
    changed = [str(copy / step.file) for step in done if step.file.endswith(".py")]
    subprocess.run([sys.executable, "-m", "ruff", "check", "--quiet", *changed], cwd=copy, check=True)
    return [step.file for step in done if step.where is None and step.file.startswith("tests/")]


def run_tests(copy: Path, tests: list[str]) -> None:
    assert tests, "a how-to ends with a test"
    assert " passed" in python(copy, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests)


TITLES = re.findall(r"^### (.+)$", TEXT, re.MULTILINE)
COMPILED = ("A loss",)


@pytest.mark.parametrize("title", [title for title in TITLES if title not in COMPILED])
def test_a_how_to_is_complete(title: str, copy: Path) -> None:
    tests = carry_out(title, copy)
    run_tests(copy, tests)
    if "make api" in how_to(title):  # that part of it which needs no Node
        before = (copy / "spiked/client/models.py").read_text(encoding="utf-8")
        python(copy, "-m", "spiked_service", "openapi", "--out", "web/openapi.json")
        python(copy, "tests/client/generate.py", "web/openapi.json")
        assert (copy / "spiked/client/models.py").read_text(encoding="utf-8") != before


@pytest.mark.slow  # compiles the renderer
@pytest.mark.parametrize("title", COMPILED)
def test_a_how_to_with_a_kernel_is_complete(title: str, copy: Path) -> None:
    tests = carry_out(title, copy)
    tools = [f"-DPython_EXECUTABLE={sys.executable}", "-G", "Ninja"]
    subprocess.run(["cmake", "-S", copy, "-B", copy / "build", *tools], check=True, capture_output=True)
    subprocess.run(["cmake", "--build", copy / "build", "--target", "_raster"], check=True, capture_output=True)
    run_tests(copy, tests)


def test_a_step_without_its_anchor_is_noticed(copy: Path) -> None:
    step = Step("spiked/errors.py", "below", "no such line", "")
    with pytest.raises(AssertionError, match="no such line"):
        step.carry_out(copy)


def test_every_target_of_make_is_there() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(re.findall(r"`make ([a-z-]+)`", TEXT)) <= targets


def test_links_lead_somewhere() -> None:
    assert dead_links(ROOT / "CONTRIBUTING.md") == []
