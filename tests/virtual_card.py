"""A capture card without hardware: a process that writes the raw stream of the PCIe camera into a pipe.

`python virtual_card.py FRAMES PIPE` writes the compact 1000x1000 frames of the file FRAMES. Like the card it sends at
its own rate; unlike it, it waits for its reader unless `--drop` is given: then it keeps `CARD_FRAMES` for a reader that
is late, and loses those that come while it is full.
"""

import argparse
import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from spiked_driver.pcie import PCIE_COMPACT_BYTES, PCIE_FRAME_BYTES, encode_pcie

PIPE_BYTES = 1 << 20
"""Room in the pipe: eight frames."""
CARD_FRAMES = 256
"""Frames that the card keeps, with `--drop`: 32 MB."""


@contextmanager
def virtual_card(
    frames: Path, pipe: Path, *, rate: float = 0.0, repeat: int = 1, damage: str = "", drop: bool = False
) -> Iterator["subprocess.Popen[str]"]:
    """Run the card; its last line on stdout is the number of frames that it dropped. Ended with the context.

    rate: frames a second, 0: as fast as they are read. damage: `KIND:FRAME,...` with `flip` (a wrong line number),
    `cut` (half of the frame is missing) and `junk` (bytes before the frame).
    """
    command = [sys.executable, __file__, str(frames), str(pipe), "--rate", str(rate), "--repeat", str(repeat)]
    command += ["--damage", damage] + ["--drop"] * drop
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def damaged(wire: NDArray[np.uint8], kinds: list[str]) -> bytes:
    """A frame of the stream, uint8 [PCIE_FRAME_BYTES], with what is wrong with it."""
    data = wire.copy()
    if "flip" in kinds:
        data[64 * 700 + 63] ^= 0x04
    sent = data.tobytes()
    if "cut" in kinds:
        sent = sent[: PCIE_FRAME_BYTES // 2]
    return (b"\x55" * 1000 if "junk" in kinds else b"") + sent


def write(pipe: int, data: bytes | memoryview) -> None:
    """Write a frame; waits for room."""
    sent = 0
    while sent < len(data):
        sent += os.write(pipe, data[sent:])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("frames", type=Path)
    parser.add_argument("pipe", type=Path)
    parser.add_argument("--rate", type=float, default=0.0)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--damage", default="")
    parser.add_argument("--drop", action="store_true")
    given = parser.parse_args()
    pixels = np.fromfile(given.frames, np.uint8).reshape(-1, PCIE_COMPACT_BYTES)
    wire = encode_pcie(pixels)
    kinds: dict[int, list[str]] = {}
    for entry in filter(None, given.damage.split(",")):
        kind, _, frame = entry.partition(":")
        kinds.setdefault(int(frame), []).append(kind)
    pipe = os.open(given.pipe, os.O_WRONLY)
    fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    kept_s = CARD_FRAMES / given.rate if given.drop and given.rate else float("inf")
    begin_s, dropped = time.monotonic(), 0
    for number in range(given.repeat * len(wire)):
        ahead_s = begin_s + number / given.rate - time.monotonic() if given.rate else 0.0
        if ahead_s > 0:
            time.sleep(ahead_s)
        if -ahead_s > kept_s:
            dropped += 1
            continue
        frame = wire[number % len(wire)]
        try:
            write(pipe, damaged(frame, kinds[number]) if number in kinds else memoryview(frame))
        except BrokenPipeError:  # nobody reads any more
            break
    os.close(pipe)
    print(dropped, flush=True)


if __name__ == "__main__":
    main()
