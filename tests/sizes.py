"""Classes of more than 300 lines and functions of more than 60, but for those listed, which must not grow.

`python tests/sizes.py` prints what breaks the rule, and exceptions that are no longer needed; then it exits with 1.
"""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = "spiked", "driver", "service", "evaluation"
MOST_CLASS, MOST_FUNCTION = 300, 60
"""Lines, as CONTRIBUTING.md has them."""
EXCEPTIONS: dict[str, int] = {
    "service/spiked_service/api/routes/devices.py:_add_profile_routes": 65,
    "service/spiked_service/api/routes/maps.py:map_routes": 84,
    "service/spiked_service/cli/commands/calibrate.py:calibrate": 90,
    "service/spiked_service/cli/commands/serve.py:serve": 79,
}
"""Most lines of what is still larger: split it, and remove its line here. None is added."""


def sizes(folder: Path) -> dict[str, tuple[int, int]]:
    """Lines of each class and function below a folder, and how many it may have, by `path:name`."""
    found = {}
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                most = MOST_CLASS if isinstance(node, ast.ClassDef) else MOST_FUNCTION
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                name = f"{path.relative_to(ROOT)}:{node.name}"
                found[name] = max(found.get(name, (0, most)), (lines, most))
    return found


def complaints() -> list[str]:
    """One sentence for each thing that breaks the rule."""
    found = {name: size for folder in FOLDERS for name, size in sizes(ROOT / folder).items()}
    larger = [
        f"{name} has {lines} lines, of at most {EXCEPTIONS.get(name, most)}: split it"
        for name, (lines, most) in found.items()
        if lines > EXCEPTIONS.get(name, most)
    ]
    needless = [
        f"{name} is small enough: remove it from EXCEPTIONS in tests/sizes.py"
        for name in EXCEPTIONS
        if name not in found or found[name][0] <= found[name][1]
    ]
    return larger + needless


if __name__ == "__main__":
    told = complaints()
    print(*told, sep="\n", end="\n" if told else "")
    sys.exit(1 if told else 0)
