"""A capture card without hardware: a process that writes the raw stream of the PCIe camera into a pipe.

`python virtual_card.py FRAMES PIPE` writes the compact 1000x1000 frames of the file FRAMES. Like the card it sends at
its own rate; unlike it, it waits for its reader unless `--drop` is given: then frames for which the pipe has no room
are lost, as in the card.
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
LATE_S = 0.1
"""Longest time for which a frame that was begun is waited for, with `--drop`."""


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


def write(pipe: int, data: bytes, drop: bool) -> bool:
    """Write a frame; false if there was no room for its first byte, with `drop`."""
    sent, due_s = 0, time.monotonic() + LATE_S
    while sent < len(data):
        try:
            sent += os.write(pipe, data[sent:])
        except BlockingIOError:
            if drop and not sent:
                return False
            if drop and time.monotonic() > due_s:
                return True  # the rest of a frame is lost in the card, too
            time.sleep(0.0002)
    return True


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
    os.set_blocking(pipe, not given.drop)
    begin_s, dropped = time.monotonic(), 0
    for number in range(given.repeat * len(wire)):
        if given.rate:
            time.sleep(max(0.0, begin_s + number / given.rate - time.monotonic()))
        frame = wire[number % len(wire)]
        data = damaged(frame, kinds[number]) if number in kinds else memoryview(frame)
        dropped += not write(pipe, data, given.drop)  # type: ignore[arg-type]
    os.close(pipe)
    print(dropped, flush=True)


if __name__ == "__main__":
    main()
