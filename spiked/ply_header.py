"""The header of a binary PLY."""

from collections.abc import Iterable, Sequence

__all__ = ["ply_header"]

Element = tuple[str, int, Iterable[str]]
"""Name and number of an element, and its properties as type and name: `float x`."""


def ply_header(elements: Sequence[Element], comments: Iterable[str] = ()) -> bytes:
    """The header of a little-endian PLY with these elements."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {one}" for one in properties)]
    return "\n".join([*lines, "end_header\n"]).encode()
