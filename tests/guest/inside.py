"""What is done in the guest: cameras on the real kernel's USB stack, and programs that use them.

Runs as root: `python inside.py OUT`, with a file of pictures, `noise.dat`, in OUT; writes OUT/report.json.
"""

import json
import os
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

USB = Path(__file__).resolve().parents[1] / "usb"
sys.path.append(str(USB))

import numpy as np  # noqa: E402
from driving import Driver  # noqa: E402
from virtual_camera.core import Camera  # noqa: E402
from virtual_camera.descriptors import Identity, Speed  # noqa: E402
from virtual_camera.faults import Fault, Kind  # noqa: E402
from virtual_camera.stream import COMPACT_BYTES, ROWS, Stream  # noqa: E402
from virtual_camera.usbip import UsbIpCamera  # noqa: E402
from wire_facts import frames_of, lines_of  # noqa: E402

VHCI = Path("/sys/devices/platform/vhci_hcd.0")
DEVICES = Path("/sys/bus/usb/devices")
_SPEEDS = {Speed.HIGH: 3, Speed.SUPER: 5}
_FIRST_SUPER_PORT = 8


class Guest:
    """The guest's USB ports."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.pictures = np.fromfile(out / "noise.dat", np.uint8).reshape(-1, COMPACT_BYTES)
        self._plugs = 0

    @property
    def environment(self) -> dict[str, str]:
        """For programs that use the cameras."""
        path = os.pathsep.join([str(USB), os.environ.get("PYTHONPATH", "")])
        return {**os.environ, "PYTHONPATH": path}

    def plug(
        self, *faults: Fault, port: int = 0, serial: str = "000000000001", speed: Speed = Speed.SUPER, lines: int = 0
    ) -> UsbIpCamera:
        """A new camera at a port of the virtual hub, when the kernel and udev know it."""
        stream = Stream(self.pictures, lines=lines, nbytes=50 * lines & 0xFFFFFFFF, faults=faults)
        return self.plug_in(Camera(stream, Identity(serial=serial), speed), port)

    def plug_in(self, known: Camera, port: int) -> UsbIpCamera:
        """A camera at a port, be it for the first time or not."""
        self._plugs += 1
        ours, theirs = socket.socketpair()
        camera = UsbIpCamera(ours, known)
        port += _FIRST_SUPER_PORT if known.speed is Speed.SUPER else 0
        before = set(cameras())
        (VHCI / "attach").write_text(f"{port} {theirs.fileno()} {self._plugs} {_SPEEDS[known.speed]}")
        theirs.close()
        until(lambda: set(cameras()) - before, "the kernel sees the camera")
        subprocess.run(["udevadm", "settle", "-t", "30"], check=True)
        return camera

    def unplug(self, camera: UsbIpCamera) -> None:
        """Pull it out, and wait until the kernel knows."""
        before = len(cameras())
        camera.unplug()
        until(lambda: len(cameras()) < before, "the kernel sees that the camera is gone")

    def call(self, function: str, *args: Any, **kwargs: Any) -> Any:
        """The result of a function of `plain_client`."""
        call = json.dumps({"args": args, "kwargs": kwargs, "user": None})
        done = subprocess.run(
            [sys.executable, "-m", "plain_client", function, call],
            env=self.environment,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
            timeout=120,
        )
        return json.loads(done.stdout)


def cameras() -> list[str]:
    """The bridges that the kernel has, by their names in sysfs and numbers."""
    found = []
    for path in DEVICES.iterdir():
        try:
            if (path / "idProduct").read_text().strip() == "601f":
                found.append(f"{path.name}#{(path / 'devnum').read_text().strip()}")
        except OSError:
            continue  # an interface, or just gone
    return found


def until(condition: Callable[[], Any], what: str, seconds: float = 60.0) -> None:
    """Wait for it. Raises TimeoutError."""
    deadline_s = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"not within {seconds:g} s: {what}")
        time.sleep(0.02)


def listed(guest: Guest) -> Any:
    """Three cameras, two with the same serial number, one at a USB 2 port."""
    plugged = [guest.plug(), guest.plug(port=1), guest.plug(port=2, speed=Speed.HIGH, serial="17")]
    found = guest.call("devices")
    for camera in plugged:
        guest.unplug(camera)
    return {"found": found, "left": guest.call("devices")}


def read(guest: Guest) -> Any:
    """Reads of 64 KiB; what came is compared outside."""
    camera = guest.plug(lines=(1 << 32) - 2 * ROWS)
    answer = guest.call("read", str(guest.out / "read.wire"), 8)
    configuration = guest.call("chip_configuration")
    guest.unplug(camera)
    return {**answer, "configuration": configuration, "requests": len(camera.camera.requests)}


def refused(guest: Guest) -> Any:
    """Transfers of 1 MiB until usbfs has no more memory for them."""
    camera = guest.plug()
    limit = Path("/sys/module/usbcore/parameters/usbfs_memory_mb").read_text().strip()
    answer = guest.call("submit_until_refused", 1 << 20)
    guest.unplug(camera)
    return {"limit": limit, "answer": answer}


def troubled(guest: Guest) -> Any:
    """A stall, a babble and a long silence, seen by pyusb."""
    camera = guest.plug(Fault(10, Kind.STALL), Fault(20, Kind.BABBLE), Fault(30, Kind.SILENCE, seconds=3.0))
    answer = guest.call("read_through_stalls", str(guest.out / "troubled.wire"), 12)
    guest.unplug(camera)
    return answer


def pulled(guest: Guest) -> Any:
    """Pulled out while it is read, and plugged in at another port."""
    first = guest.plug(Fault(30, Kind.UNPLUG))
    answer = guest.call("read", str(guest.out / "pulled.wire"), 50)
    until(lambda: not cameras(), "the camera is gone")
    second = guest.plug(port=3, lines=1000)
    again = guest.call("read", str(guest.out / "again.wire"), 3)
    found = guest.call("devices")
    guest.unplug(second)
    first.unplugged.wait(10)
    return {"first": answer, "second": again, "found": found, "lines": lines_of(frames_of(guest.out / "again.wire"))}


def discarded(guest: Guest) -> Any:
    """poll, discard and reap by bare ioctls."""
    camera = guest.plug()
    answer = guest.call("poll_and_discard")
    guest.unplug(camera)
    return answer


def driven(guest: Guest) -> Any:
    """The driver through dropped frames, a stall, a babble, and its camera pulled out and plugged in elsewhere."""
    rate = 250
    stream = Stream(guest.pictures, rate_hz=rate, buffer_frames=4 * rate)
    known = Camera(stream)
    camera = guest.plug_in(known, 0)
    driver = Driver(guest, f"usb0?rate={rate}&silence_s=3&transfer_kib=64&hide_ms=1000", patience_s=120.0)
    driver.wait_for_frames(100)
    for kind in (Kind.DROP, Kind.STALL, Kind.BABBLE):
        camera.add(Fault(1, kind, count=7))
        driver.wait_for_frames(2 * rate)
    seen = len(driver.observed.states)
    guest.unplug(camera)
    driver.wait_for_state("absent", after=seen)
    stream.power_on(lines=1000, nbytes=77)
    guest.plug_in(known, 4)
    driver.wait_for_state("streaming", after=len(driver.observed.states))
    driver.wait_for_frames(rate)
    observed = driver.stop()
    return {
        "states": observed.states,
        "gaps": observed.gaps,
        "end": observed.end,
        "received": observed.received,
        "offsets": observed.offsets,
        "closed_s": observed.closed_s,
        "sent": all(
            any(run.first <= number and number + count <= run.first + run.count for run in stream.sent)
            for (_, number), count in observed.runs.items()
            if count
        ),
    }


SCENES = (listed, read, refused, troubled, pulled, discarded, driven)


def main() -> None:
    """Play every scene; one that fails leaves its traceback, and the next one is played."""
    out = Path(sys.argv[1])
    guest = Guest(out)
    report: dict[str, Any] = {}
    for scene in SCENES:
        start_s = time.monotonic()
        try:
            report[scene.__name__] = scene(guest)
        except Exception:
            report[scene.__name__] = {"traceback": traceback.format_exc()}
        print(f"{scene.__name__}: {time.monotonic() - start_s:.1f} s", flush=True)
        (out / "report.json").write_text(json.dumps(report))


if __name__ == "__main__":
    main()
