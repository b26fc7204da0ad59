"""Prints the tests that concern what changed: `python tests/changed.py [COMMIT]`; by default against the main branch.

A test file is chosen if it changed itself, or imports a module that changed. A change of C++ counts as a change of the
Python modules that import the compiled module of that folder. Deeper dependents, and suites that start browsers or
daemons (`LEFT_OUT`), are left to `make test`.
"""

import ast
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LEFT_OUT = ("tests/e2e", "tests/soak", "tests/web", "tests/guest")
PACKAGES = {"spiked": ROOT, "spiked_driver": ROOT / "driver", "spiked_service": ROOT / "service"}


def git(*words: str) -> list[str]:
    """Lines of output."""
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def base() -> str:
    """The commit where this branch left the main one."""
    for name in ("origin/main", "main"):
        words = ["git", "merge-base", "HEAD", name]
        found = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        if found.returncode == 0:
            return found.stdout.strip()
    return "HEAD"


def changed(commit: str) -> set[Path]:
    """Files that differ from a commit, untracked ones too, relative to the root."""
    names = [*git("diff", "--name-only", commit), *git("ls-files", "--others", "--exclude-standard")]
    return {Path(name) for name in names}


def module_of(file: Path) -> str | None:
    """The dotted name of a file of our packages."""
    parts = file.with_suffix("").parts
    if parts and parts[0] in ("driver", "service"):
        parts = parts[1:]
    if file.suffix != ".py" or not parts or parts[0] not in PACKAGES:
        return None
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(file: Path) -> set[str]:
    """Every module and name that a file imports from our packages, dotted."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module)
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return {name for name in found if name.split(".")[0] in PACKAGES}


def compiled(files: Iterable[Path]) -> set[str]:
    """Modules of Python that import what is compiled from changed C++."""
    folders = {file.parent.name for file in files if file.parts[:2] == ("spiked", "native") and file.suffix != ".py"}
    names = {f"spiked.native._{folder}" for folder in folders}
    found = set()
    for root in PACKAGES.values():
        for file in root.glob("*/**/*.py") if root == ROOT else root.rglob("*.py"):
            name = module_of(file.relative_to(ROOT))
            if name and imports(file) & names:
                found.add(name)
    return found


def chosen(files: set[Path]) -> list[str]:
    """Test files to run, relative to the root."""
    modules = {name for file in files if (name := module_of(file))} | compiled(files)
    tests = [test.relative_to(ROOT) for test in sorted((ROOT / "tests").rglob("test_*.py"))]
    near = [test for test in tests if not str(test).startswith(LEFT_OUT)]
    return [str(test) for test in near if test in files or imports(ROOT / test) & modules]


if __name__ == "__main__":
    print("\n".join(chosen(changed(sys.argv[1] if len(sys.argv) > 1 else base()))))
