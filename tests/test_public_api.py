"""The public API: every exported name is documented, arrays with their shapes, and the site is built from it."""

import ast
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
ARRAYS = re.compile(r"NDArray|ArrayLike|ndarray|\bArray\b|Floats|Image\b")
SHAPE = re.compile(r"\[[\w<=., *+/()-]+\]|the shape of|See `")
"""A shape in brackets, or where it is stated."""


def modules() -> list[str]:
    """Public modules: those with `__all__`."""
    files = [*(ROOT / "spiked").glob("*.py"), *(ROOT / "spiked").glob("*/__init__.py"), ROOT / "spiked/render/torch.py"]
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
