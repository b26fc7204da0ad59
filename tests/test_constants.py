"""Constants say what they are: a number with a name has a docstring with its unit, or a comment on its line."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
GENERATED = ROOT / "spiked/client/models.py"
FILES = [
    file
    for folder in ("spiked", "driver/spiked_driver", "service/spiked_service")
    for file in sorted((ROOT / folder).rglob("*.py"))
    if file != GENERATED
]


def is_number(node: ast.expr) -> bool:
    """A number, an expression with one, or a tuple of numbers."""
    match node:
        case ast.Constant(value=value):
            return isinstance(value, int | float) and not isinstance(value, bool)
        case ast.UnaryOp(operand=operand):
            return is_number(operand)
        case ast.BinOp(left=left, right=right):
            return is_number(left) or is_number(right)
        case ast.Tuple(elts=elements):
            return bool(elements) and all(is_number(element) for element in elements)
    return False


def is_text(node: ast.stmt) -> bool:
    match node:
        case ast.Expr(value=ast.Constant(value=str())):
            return True
    return False


def undocumented(source: str) -> Iterator[str]:
    """Names of the constants of a module, written in capitals, that say nothing."""
    lines, body = source.splitlines(), ast.parse(source).body
    for node, after in zip(body, [*body[1:], ast.Pass()], strict=True):
        match node:
            case ast.Assign(targets=[target], value=value) if is_number(value) and ast.unparse(target).isupper():
                if not is_text(after) and "  # " not in lines[node.lineno - 1]:
                    yield ast.unparse(target)


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_constants_say_what_they_are(file: Path) -> None:
    assert list(undocumented(file.read_text())) == []


def test_a_constant_that_says_nothing_is_found() -> None:
    source = 'A = 1\nB = 2  # px\nC = 3\n"""Seconds."""\n_D, E = -1, 2.5 * 3\nTEXT = "x"\nsmall = 4\nF = 1 << 20\n'
    assert list(undocumented(source)) == ["A", "(_D, E)", "F"]
