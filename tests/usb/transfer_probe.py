"""Queued reads by themselves, in a process that sees the virtual cameras: `python -m transfer_probe FUNCTION JSON`."""

import json
import sys
import time
from typing import Any

from spiked_driver.libusb import OutOfUsbMemoryError
from spiked_driver.transfers import Buffers, BulkReader
from spiked_driver.usb_budget import TransferPlan
from spiked_driver.usb_cameras import find_cameras
from spiked_driver.usb_session import UsbSession

_WAIT_S = 5.0


def _open(count: int, transfer_bytes: int, asynchronous: bool = True) -> UsbSession:
    plan = TransferPlan(count, transfer_bytes, 260e6)
    return UsbSession(find_cameras()[0], Buffers(plan), asynchronous=asynchronous)


def _take(reader: BulkReader, file: str, count: int) -> tuple[list[int], list[str]]:
    lengths, errors = [], []
    with open(file, "ab") as out:  # noqa: PTH123
        for _ in range(count):
            transfer = reader.next(_WAIT_S)
            assert transfer is not None
            lengths.append(transfer.data.size)
            out.write(transfer.data.tobytes())
            if transfer.error:
                errors.append(transfer.error.name)
                break
            reader.release()
    return lengths, errors


def read(file: str, count: int, transfer_bytes: int, transfers: int, asynchronous: bool = True) -> dict[str, Any]:
    """Arrivals into a file; their lengths, what went wrong, and the bridge as it described itself."""
    session = _open(count, transfer_bytes, asynchronous)
    session.reader.start()
    lengths, errors = _take(session.reader, file, transfers)
    chip = session.chip
    in_flight = session.reader.in_flight_bytes
    session.close(1.0)
    return {
        "lengths": lengths,
        "errors": errors,
        "in_flight": in_flight,
        "chip": chip and [chip.vendor_id, chip.product_id, chip.fifo_clock],
    }


def budget(count: int, transfer_bytes: int) -> dict[str, Any]:
    """What is in flight if the kernel takes less than was planned."""
    session = _open(count, transfer_bytes)
    try:
        session.reader.start()
        return {"in_flight": session.reader.in_flight_bytes}
    except OutOfUsbMemoryError as error:
        return {"refused": str(error)}
    finally:
        session.close(1.0)


def stop_and_start(file: str, count: int, transfer_bytes: int) -> dict[str, Any]:
    """Stop with everything in flight, take what had come, start again."""
    session = _open(count, transfer_bytes)
    session.reader.start()
    first, _ = _take(session.reader, file, 2)
    time.sleep(0.2)
    ended = session.reader.stop(1.0)
    left = []
    with open(file, "ab") as out:  # noqa: PTH123
        while (transfer := session.reader.next(0)) is not None:
            left.append(transfer.data.size)
            out.write(transfer.data.tobytes())
            session.reader.release()
    session.rearm()
    again = session.reader.next(_WAIT_S)
    session.close(1.0)
    return {"first": first, "ended": ended, "left": left, "again": again is not None and int(again.data.size)}


def underruns(count: int, transfer_bytes: int, transfers: int) -> list[int | None]:
    """`underrun_bytes` after each of so many reads."""
    session = _open(count, transfer_bytes)
    session.reader.start()
    found = []
    for _ in range(transfers):
        assert session.reader.next(_WAIT_S) is not None
        session.reader.release()
        found.append(session.reader.underrun_bytes())
    session.close(1.0)
    return found


def unread() -> float:
    """How long closing takes when nothing was ever asked for a second time."""
    session = _open(8, 1 << 20)
    session.reader.start()
    start_s = time.monotonic()
    session.close(1.0)
    return time.monotonic() - start_s


if __name__ == "__main__":
    function, arguments = sys.argv[1], json.loads(sys.argv[2])
    print(json.dumps(globals()[function](**arguments), default=int))
