"""Queued reads at the virtual camera: order, requests, budget, short transfers, stopping; and what leans on pyusb."""

import ctypes
import importlib.metadata
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import usb.backend.libusb1
from spiked_driver import framing, transfers
from spiked_driver.libusb import OutOfUsbMemoryError, Transfer
from spiked_driver.transfers import AsynchronousBulkReader, Buffers
from spiked_driver.usb_budget import TransferPlan
from virtual_camera.faults import Fault, Kind
from virtual_camera.host import CameraSettings
from virtual_camera.rig import VirtualCameras
from virtual_camera.stream import FRAME_BYTES

Cameras = Callable[..., VirtualCameras]
PROJECT = Path(__file__).parents[2] / "pyproject.toml"


def probe(rig: VirtualCameras, function: str, **arguments: Any) -> Any:
    """The result of a function of `transfer_probe`."""
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-m", "transfer_probe", function, json.dumps(arguments, default=str)],
        env={**rig.environment, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=60,
    )
    return json.loads(done.stdout)


def numbers(file: Path) -> list[int]:
    """The camera's numbers of the whole frames in a wire file, by our own parser; checked to be without a gap."""
    parser, view = framing.UsbFraming(), np.zeros((10_000, framing.USB_COMPACT_BYTES), np.uint8)
    parser.feed(file.read_bytes())
    chunk = parser.read_into(view)
    assert isinstance(chunk, framing.Chunk)
    return view[: chunk.frames, :8].copy().view("<i8")[:, 0].tolist()


@pytest.mark.parametrize("asynchronous", [True, False])
def test_bytes_come_in_the_cameras_order_each_read_asked_for(
    cameras: Cameras, pictures: Path, tmp_path: Path, asynchronous: bool
) -> None:
    rig = cameras(CameraSettings(str(pictures)))
    size = 1 << 17
    answer = probe(
        rig, "read", file=tmp_path / "wire", count=5, transfer_bytes=size, transfers=23, asynchronous=asynchronous
    )
    assert answer["lengths"] == [size] * 23
    assert answer["errors"] == []
    assert answer["chip"] == [0x0403, 0x601F, 0]
    taken = numbers(tmp_path / "wire")
    assert taken == list(range(len(taken)))
    assert len(taken) >= 23 * size // FRAME_BYTES - 1
    report = rig.report()
    assert report.bad_requests == 0
    assert [index for index, _ in report.requests] == list(range(len(report.requests)))
    assert {length for _, length in report.requests} == {size}
    assert report.in_flight_bytes == 0


def test_a_short_transfer_is_data(cameras: Cameras, pictures: Path, tmp_path: Path) -> None:
    rig = cameras(CameraSettings(str(pictures), faults=(Fault(4, Kind.CUT, offset=700), Fault(20, Kind.CUT, offset=3))))
    answer = probe(rig, "read", file=tmp_path / "wire", count=4, transfer_bytes=1 << 17, transfers=8)
    assert answer["lengths"][0] == 4 * FRAME_BYTES + 700
    assert sum(length < 1 << 17 for length in answer["lengths"]) == 2
    assert numbers(tmp_path / "wire")[:25] == list(range(25))


@pytest.mark.parametrize(("kind", "error"), [(Kind.STALL, "STALLED"), (Kind.BABBLE, "BABBLE")])
def test_trouble_comes_after_the_bytes_before_it(
    cameras: Cameras, pictures: Path, tmp_path: Path, kind: Kind, error: str
) -> None:
    rig = cameras(CameraSettings(str(pictures), faults=(Fault(30, kind),)))
    answer = probe(rig, "read", file=tmp_path / "wire", count=4, transfer_bytes=1 << 16, transfers=50)
    assert answer["errors"] == [error]
    taken = numbers(tmp_path / "wire")
    assert taken == list(range(len(taken)))
    # What a babbling camera sent last is lost with its transfer.
    assert len(taken) == 30 if kind is Kind.STALL else 25 <= len(taken) <= 30


def test_where_the_kernel_takes_fewer_those_are_used(cameras: Cameras, pictures: Path) -> None:
    rig = cameras(CameraSettings(str(pictures)), usbfs_memory_mb=16)
    assert probe(rig, "budget", count=20, transfer_bytes=1 << 20) == {"in_flight": 15 << 20}
    assert "NO_MEM" in probe(rig, "budget", count=8, transfer_bytes=6 << 20)["refused"]


def test_what_had_come_before_stopping_is_not_lost(cameras: Cameras, pictures: Path, tmp_path: Path) -> None:
    size = 1 << 16
    rig = cameras(CameraSettings(str(pictures)))
    answer = probe(rig, "stop_and_start", file=tmp_path / "wire", count=8, transfer_bytes=size)
    assert answer["first"] == [size] * 2
    assert answer["ended"]
    assert len(answer["left"]) == 8
    taken = numbers(tmp_path / "wire")
    assert taken == list(range(len(taken)))
    assert len(taken) >= (sum(answer["left"]) + 2 * size) // FRAME_BYTES - 1
    assert answer["again"] == size


def test_an_underrun_is_before_the_bytes_of_the_reads_that_end_it(cameras: Cameras, pictures: Path) -> None:
    """The camera fills each new read at once, so all others have completed before it, and it soon has bytes as well."""
    count, size = 8, 1 << 16
    rig = cameras(CameraSettings(str(pictures)))
    found = [waiting for waiting in probe(rig, "underruns", count=count, transfer_bytes=size, transfers=50) if waiting]
    assert found
    assert max(found) <= (count - 1) * size


def test_closing_with_everything_in_flight_is_quick(cameras: Cameras, pictures: Path) -> None:
    rig = cameras(CameraSettings(str(pictures), faults=(Fault(0, Kind.SILENCE, seconds=60),)))
    assert probe(rig, "unread") < 1.0


class Inert:
    """A context whose transfers never end, or are refused: what no camera can be brought to do."""

    def __init__(self, refuse: bool = False) -> None:
        self.made: list[Transfer] = []
        self.freed: list[Transfer] = []
        self.refuse = refuse

    def allocate(self, endpoint: int, buffer: int, length: int, callback: Any) -> Transfer:
        self.made.append(Transfer())
        return self.made[-1]

    def submit(self, transfer: Transfer) -> None:
        if self.refuse:
            raise OutOfUsbMemoryError("no")

    def cancel(self, transfer: Transfer) -> None: ...

    def handle_events(self, timeout_s: float) -> None: ...

    def free(self, transfer: Transfer) -> None:
        self.freed.append(transfer)


def test_transfers_that_never_end_are_left_alone_after_the_deadline() -> None:
    context = Inert()
    reader = AsynchronousBulkReader(context, Buffers(TransferPlan(4, 1 << 16, 1e6)))  # type: ignore[arg-type]
    reader.start()
    assert not reader.stop(0.05)
    assert not reader.close()
    assert context.freed == []
    assert reader in transfers._abandoned
    transfers._abandoned.remove(reader)


def test_transfers_that_were_never_queued_are_freed() -> None:
    context = Inert(refuse=True)
    reader = AsynchronousBulkReader(context, Buffers(TransferPlan(4, 1 << 16, 1e6)))  # type: ignore[arg-type]
    with pytest.raises(OutOfUsbMemoryError):
        reader.start()
    assert reader.stop(0.05)
    assert reader.close()
    assert {id(transfer) for transfer in context.freed} == {id(transfer) for transfer in context.made}


def test_pyusb_is_the_version_whose_private_parts_we_know() -> None:
    pinned = re.search(r'"pyusb==([\d.]+)"', PROJECT.read_text())
    assert pinned is not None
    assert importlib.metadata.version("pyusb") == pinned[1]


def test_a_transfer_is_laid_out_as_pyusb_says() -> None:
    theirs = usb.backend.libusb1._libusb_transfer
    for name, _ in Transfer._fields_:
        assert getattr(Transfer, name).offset == getattr(theirs, name).offset, name
        assert getattr(Transfer, name).size == getattr(theirs, name).size, name
    assert ctypes.sizeof(Transfer) <= ctypes.sizeof(theirs)
