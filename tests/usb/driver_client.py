"""The driver at work in a process that sees the virtual cameras: `python -m driver_client SPEC [USER]`.

It opens a source, reads it until it is told to stop, and prints what comes as JSON lines: states, gaps, and runs of
frames with the camera's numbers. With a second argument it becomes that user.
"""

import json
import logging
import os
import sys
import threading
import time
from typing import Any

import numpy as np
from spiked_driver import Chunk, open_source
from spiked_driver.libusb import load_libusb

from spiked.errors import SpikedError
from spiked.ring import DeviceStatus, Gap

_BLOCK = 8
_TELL_S = 0.1


def main() -> None:
    """Read until standard input says so."""
    logging.basicConfig(level="WARNING")
    start_s = time.monotonic()

    def tell(**event: Any) -> None:
        print(json.dumps({"at": time.monotonic() - start_s, **event}), flush=True)

    stop, pause, resume = threading.Event(), threading.Event(), threading.Event()
    threading.Thread(target=_listen, args=(stop, pause, resume), daemon=True).start()
    if len(sys.argv) > 2:
        load_libusb()  # nobody may not look for libraries everywhere
        os.setuid(int(sys.argv[2]))
    try:
        source = open_source(sys.argv[1], warn=lambda text: tell(warning=text))
        source.open()
        tell(opened=True)
        last: DeviceStatus | None = None
        run = [0, 0, 0]
        told_s = 0.0
        view = np.zeros((_BLOCK, source.sensor.frame_bytes), np.uint8)
        while not stop.is_set():
            item = source.read_into(view)
            numbers = []
            if isinstance(item, Chunk):
                numbers = view[: item.frames, :8].copy().view("<i8")[:, 0].tolist()
            if isinstance(item, Gap) or source.device_status != last or time.monotonic() - told_s > _TELL_S:
                tell(run=run)
                told_s = time.monotonic()
            for offset, number in enumerate(numbers):
                index = item.first + offset
                if (index, number) != (run[0] + run[2], run[1] + run[2]):
                    tell(run=run)
                    run = [index, number, 0]
                run[2] += 1
            if isinstance(item, Gap):
                tell(gap=[item.first, item.count, item.cause])
            if source.device_status != last:
                last = source.device_status
                tell(state=last.state, reason=last.reason)
            if pause.is_set():
                pause.clear()
                resume.wait()
                resume.clear()
        tell(run=run)
        before_s = time.monotonic()
        source.close()
        tell(closed_s=time.monotonic() - before_s)
    except SpikedError as error:
        tell(error=str(error))


def _listen(stop: threading.Event, pause: threading.Event, resume: threading.Event) -> None:
    for line in sys.stdin:
        {"pause\n": pause, "resume\n": resume}.get(line, stop).set()
    stop.set()
    resume.set()


if __name__ == "__main__":
    main()
