"""Arrays of NumPy from files that anybody may have made: headers are checked before memory is taken."""

import io
import lzma
import math
import tokenize
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["UNREADABLE", "array_header", "read_npz"]

UNREADABLE = (
    OSError,
    ValueError,
    EOFError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    KeyError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
)
"""Errors of the libraries for files that are damaged, encrypted, or compressed in a way that they do not know."""
MOST_HEADER_BYTES = 10_000
"""Longest header of an array; that of a plain one has 128 bytes, and a packed one could fill the memory."""
_MAGIC_BYTES = 8
"""`\\x93NUMPY` and the version."""


def array_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether it is in Fortran order, and type of an array in the `.npy` format; reads up to its first element.

    Raises what `UNREADABLE` lists.
    """
    version = np.lib.format.read_magic(file)
    length_bytes = 2 if version == (1, 0) else 4
    length = int.from_bytes(file.read(length_bytes), "little")
    if length > MOST_HEADER_BYTES:
        raise ValueError(f"its header has {length} bytes, more than {MOST_HEADER_BYTES}")
    return _parsed(version, length.to_bytes(length_bytes, "little") + file.read(length))


def _parsed(version: tuple[int, int], content: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    file = io.BytesIO(content)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    if any(side < 0 for side in shape):
        raise ValueError(f"its shape is {list(shape)}")
    return shape, fortran, dtype


def read_npz(path: Path, names: Iterable[str], most_bytes: int) -> list[NDArray[Any]]:
    """Arrays of an `.npz` file, of any shape [...], none larger than `most_bytes`. Raises what `UNREADABLE` lists."""
    found = []
    with zipfile.ZipFile(path) as archive:
        for name in names:
            with archive.open(f"{name}.npy") as file:
                shape, fortran, dtype = array_header(file)
                size = math.prod(shape) * dtype.itemsize
                if size > most_bytes:
                    raise ValueError(f"{name} has {size} bytes, more than {most_bytes}")
                content = file.read(size)
            if len(content) != size:
                raise EOFError(f"{name} has {len(content)} of {size} bytes")
            found.append(np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C"))
    return found
