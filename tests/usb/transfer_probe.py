"""Queued reads by themselves, in a process that sees the virtual cameras: `python -m transfer_probe FUNCTION JSON`."""

import json
import sys
import time
from typing import Any

from spiked_driver.libusb import OutOfUsbMemoryError
from spiked_driver.transfers import Buffers, Reads
from spiked_driver.usb_budget import TransferPlan
from spiked_driver.usb_cameras import find_cameras
from spiked_driver.usb_session import UsbSession

_WAIT_S = 5.0


def _open(count: int, transfer_bytes: int, asynchronous: bool = True) -> UsbSession:
    plan = TransferPlan(count, transfer_bytes, 260e6)
    return UsbSession(find_cameras()[0], Buffers(plan), asynchronous=asynchronous)


def _take(reads: Reads, file: str, arrivals: int) -> tuple[list[int], list[str]]:
    lengths, troubles = [], []
    with open(file, "ab") as out:  # noqa: PTH123
        for _ in range(arrivals):
            arrival = reads.next(_WAIT_S)
            assert arrival is not None
            lengths.append(arrival.data.size)
            out.write(arrival.data.tobytes())
            if arrival.trouble:
                troubles.append(arrival.trouble.name)
                break
            reads.release()
    return lengths, troubles


def read(file: str, count: int, transfer_bytes: int, arrivals: int, asynchronous: bool = True) -> dict[str, Any]:
    """Arrivals into a file; their lengths, what went wrong, and the bridge as it described itself."""
    session = _open(count, transfer_bytes, asynchronous)
    session.reads.start()
    lengths, troubles = _take(session.reads, file, arrivals)
    chip = session.chip
    in_flight = session.reads.in_flight_bytes
    session.close(1.0)
    return {
        "lengths": lengths,
        "troubles": troubles,
        "in_flight": in_flight,
        "chip": chip and [chip.vendor_id, chip.product_id, chip.fifo_clock],
    }


def budget(count: int, transfer_bytes: int) -> dict[str, Any]:
    """What is in flight if the kernel takes less than was planned."""
    session = _open(count, transfer_bytes)
    try:
        session.reads.start()
        return {"in_flight": session.reads.in_flight_bytes}
    except OutOfUsbMemoryError as error:
        return {"refused": str(error)}
    finally:
        session.close(1.0)


def stop_and_start(file: str, count: int, transfer_bytes: int) -> dict[str, Any]:
    """Stop with everything in flight, take what had come, start again."""
    session = _open(count, transfer_bytes)
    session.reads.start()
    first, _ = _take(session.reads, file, 2)
    time.sleep(0.2)
    ended = session.reads.stop(1.0)
    left = []
    with open(file, "ab") as out:  # noqa: PTH123
        while (arrival := session.reads.next(0)) is not None:
            left.append(arrival.data.size)
            out.write(arrival.data.tobytes())
            session.reads.release()
    session.rearm()
    again = session.reads.next(_WAIT_S)
    session.close(1.0)
    return {"first": first, "ended": ended, "left": left, "again": again is not None and int(again.data.size)}


def unread() -> float:
    """How long closing takes when nothing was ever asked for a second time."""
    session = _open(8, 1 << 20)
    session.reads.start()
    start_s = time.monotonic()
    session.close(1.0)
    return time.monotonic() - start_s


if __name__ == "__main__":
    function, arguments = sys.argv[1], json.loads(sys.argv[2])
    print(json.dumps(globals()[function](**arguments), default=int))
