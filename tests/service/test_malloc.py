"""What a process gives back to the system of the memory that it has freed."""

import subprocess
import sys

import pytest

BLOCKS = 64
BLOCK_BYTES = 4 << 20
SMALL_BYTES = 50_000
PROGRAM = f"""
import numpy as np
import psutil
from spiked_service.base.malloc import return_freed

resident = lambda: psutil.Process().memory_info().rss
del (first := [np.ones({BLOCK_BYTES}, np.uint8)])[:]  # from now on glibc has blocks of this size in its heap
return_freed()
begun = resident()
large, small = [], []
for _ in range({BLOCKS}):
    large.append(np.ones({BLOCK_BYTES}, np.uint8))
    small.append(np.ones({SMALL_BYTES}, np.uint8))
large.clear()
freed = resident()
return_freed()
print(freed - begun, resident() - begun)
assert all(array.all() for array in small)
"""


def test_freed_blocks_between_ones_in_use_are_returned() -> None:
    run = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    before, after = map(int, run.stdout.split())
    if before < BLOCKS * BLOCK_BYTES / 2:
        pytest.skip(f"this malloc kept only {before} bytes by itself")
    assert after < BLOCKS * SMALL_BYTES + 4 * BLOCK_BYTES
