"""The public API: every exported name is documented, arrays with their shapes, and the site is built from it."""

import ast
import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
ARRAYS = re.compile(r"NDArray|ArrayLike|ndarray|\bArray\b|Floats|Image\b")
SHAPE = re.compile(r"\[[\w<=., *+/()-]+\]|the shape of|See `")
"""A shape in brackets, or where it is stated."""


def site_pages() -> ModuleType:
    """docs/site_pages.py."""
    pytest.importorskip("mkdocs", reason="mkdocs is not installed (make docs)")
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "docs" / "site_pages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def modules() -> list[str]:
    """Public modules: those with `__all__`."""
    files = [*(ROOT / "spiked").glob("*.py"), *(ROOT / "spiked").glob("*/__init__.py")]
    files += (ROOT / "driver" / "spiked_driver").glob("*.py")
    found = []
    for file in files:
        names = [node for node in ast.parse(file.read_text()).body if isinstance(node, ast.Assign)]
        if any(isinstance(target, ast.Name) and target.id == "__all__" for node in names for target in node.targets):
            parts = file.with_suffix("").relative_to(ROOT / "driver" if "driver" in file.parts else ROOT).parts
            found.append(".".join(part for part in parts if part != "__init__"))
    return sorted(found)


def functions(module: ModuleType) -> Iterator[tuple[str, Any, str]]:
    """Exported functions and public methods: name, function, and of a method what its class says of its fields."""
    for name in module.__all__:
        thing = getattr(module, name)
        if inspect.isfunction(thing):
            yield name, thing, ""
        elif inspect.isclass(thing) and thing.__module__.startswith("spiked"):
            fields = inspect.getsource(thing).split("    def ")[0]
            for method, value in vars(thing).items():
                function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
                if inspect.isfunction(function) and (method == "__init__" or not method.startswith("_")):
                    yield f"{name}.{method}", function, fields


@pytest.mark.parametrize("name", modules())
def test_every_exported_name_has_a_docstring(name: str) -> None:
    module = importlib.import_module(name)
    source = inspect.getsource(module)
    for exported in module.__all__:
        thing = getattr(module, exported)
        if inspect.isclass(thing) or inspect.isfunction(thing):
            assert vars(thing).get("__doc__") if inspect.isclass(thing) else thing.__doc__, f"{name}.{exported}"
        elif re.search(rf"^{exported}\b", source, re.MULTILINE):  # a constant or a type: a docstring below it
            assert re.search(rf'^{exported}\b[^=\n]*=(?:.|\n)*?\n"""', source, re.MULTILINE), f"{name}.{exported}"
    for exported, function, _ in functions(module):
        assert function.__doc__ or exported.endswith("__init__"), f"{name}.{exported}"


@pytest.mark.parametrize("name", modules())
def test_docstrings_of_functions_on_arrays_state_shapes(name: str) -> None:
    module = importlib.import_module(name)
    silent = []
    for exported, function, of_class in functions(module):
        annotations = [str(value) for value in function.__annotations__.values()]
        if ARRAYS.search(" ".join(annotations)) and not SHAPE.search((function.__doc__ or "") + of_class):
            silent.append(exported)
    assert silent == []


def test_the_site_is_built_with_strict_links(tmp_path: Path) -> None:
    pages = site_pages().generated()
    assert {f"reference/{name}.md" for name in modules()} <= set(pages)
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", tmp_path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    scene = (tmp_path / "reference" / "spiked.scene.html").read_text()
    assert 'id="spiked.scene.Scene.write_ply"' in scene
    assert "spiked reconstruct" in (tmp_path / "index.html").read_text()
