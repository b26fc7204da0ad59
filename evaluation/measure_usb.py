"""The tables of docs/usb-figures.md, measured against the virtual camera of tests/usb.

`python evaluation/measure_usb.py throughput`, `... faults`, `... losses --seconds 600`; each prints Markdown.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from spiked_driver.framing import USB_COMPACT_BYTES, USB_FRAME_BYTES, benchmark_usb
from spiked_driver.pcie import benchmark_pcie

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests/usb"))
from driving import Driver
from virtual_camera.faults import Fault, Kind
from virtual_camera.host import CameraSettings
from virtual_camera.rig import VirtualCameras
from whole_driver import run

RATE_HZ = 20_000.0
SLOW_HZ = 2000.0
"""For the faults: their times are the driver's, not those of the frames."""
SOON = 1


def throughput(pictures: Path) -> None:
    """Each stage next to a plain copy of the same bytes."""
    wire, raw = benchmark_usb(), benchmark_pcie()
    print("| stage | MB/s | share of memcpy |\n|---|---|---|")
    speeds = []
    cpu_s = 0.0
    for _ in range(3):
        rig = VirtualCameras([CameraSettings(str(pictures))], usbfs_memory_mb=256)
        try:
            account = run(rig, "usb0", 60_000, None)
        finally:
            rig.close()
        speeds.append(USB_FRAME_BYTES * account.received / account.seconds)
        cpu_s = account.acquisition_cpu_s / account.received
    best = max(speeds)
    rows = [
        ("virtual camera to ring, all processes", best, best / wire.memcpy_bytes_a_second),
        ("framing of the USB3 stream", wire.parsed_bytes_a_second, wire.ratio),
        ("parser of the raw PCIe stream", raw.parsed_bytes_a_second, raw.ratio),
        ("memcpy of the USB3 stream", wire.memcpy_bytes_a_second, 1.0),
        ("memcpy of the PCIe stream", raw.memcpy_bytes_a_second, 1.0),
    ]
    for stage, speed, share in rows:
        print(f"| {stage} | {speed / 1e6:,.0f} | {share:.2f} |")
    print(f"\nAcquisition: {100 * cpu_s * RATE_HZ:.0f} % of a core for 20,000 frames a second.")


def losses(pictures: Path, seconds: float) -> None:
    """A long capture at the camera's rate, every frame compared."""
    rig = VirtualCameras([CameraSettings(str(pictures), rate_hz=RATE_HZ)], usbfs_memory_mb=256)
    try:
        account = run(rig, "usb0", round(seconds * RATE_HZ), pictures, timeout_s=2 * seconds + 60)
        report = rig.report()
    finally:
        rig.close()
    account.check(report)
    assert account.first_number is not None
    first, end = account.first_number, account.first_number + account.end
    sent = sum(max(0, min(end, one.first + one.count) - max(first, one.first)) for one in report.sent)
    print("| | frames |\n|---|---|")
    print(f"| of the camera, from the first to the last of the capture | {end - first:,} |")
    print(f"| sent: there was room for them | {sent:,} |")
    print(f"| received, each equal to what was sent | {account.received:,} |")
    for cause in ("device", "usb", "ring", "disk"):
        print(f"| lost: {cause} | {account.lost.get(cause, 0):,} |")
    print(f"| received + lost | {account.received + account.lost_frames:,} |")
    cores = account.acquisition_cpu_s / seconds
    largest = "" if account.largest_gap is None else " (the largest at frame {:,}: {:,})".format(*account.largest_gap)
    print(f"\n{account.gaps} gaps{largest}; the acquisition process used {100 * cores:.0f} % of a core.")


@dataclass(frozen=True)
class _Trouble:
    """Something that befalls the camera, and how long it lasts by itself."""

    name: str
    happen: Callable[[VirtualCameras], None]
    lasts_s: float = 0.0
    lost_state: bool = True


def _fault(kind: Kind, *, offset: int = 0, count: int = 1, seconds: float = 0.0) -> Callable[[VirtualCameras], None]:
    return lambda rig: rig.fault(Fault(SOON, kind, offset=offset, count=count, seconds=seconds))


def _unplug(port: str | None) -> Callable[[VirtualCameras], None]:
    return lambda rig: rig.fault(Fault(SOON, Kind.UNPLUG, seconds=1.0, port=port))


TROUBLES = (
    _Trouble("the camera drops 7 frames", _fault(Kind.DROP, count=7), lost_state=False),
    _Trouble("a frame comes three times", _fault(Kind.REPEAT, count=2), lost_state=False),
    _Trouble("a bit of a header is wrong", _fault(Kind.FLIP, offset=2), lost_state=False),
    _Trouble("a bit of a row number is wrong", _fault(Kind.FLIP, offset=66), lost_state=False),
    _Trouble("512 bytes are missing", _fault(Kind.LOSE, offset=4000, count=512), lost_state=False),
    _Trouble("5,000 bytes of junk", _fault(Kind.JUNK, count=5000), lost_state=False),
    _Trouble("a transfer ends short", _fault(Kind.CUT, offset=1000), lost_state=False),
    _Trouble("stall (EPIPE)", _fault(Kind.STALL)),
    _Trouble("babble (EOVERFLOW)", _fault(Kind.BABBLE)),
    _Trouble("silence for 2 s", _fault(Kind.SILENCE, seconds=2.0), 2.0),
    _Trouble("unplugged for 1 s", _unplug(None), 1.0),
    _Trouble("unplugged for 1 s, back at another port", _unplug("2-4.1"), 1.0),
)


def faults(pictures: Path) -> None:
    """What each fault costs, and when frames come again."""
    print("| fault | frames lost | cause | states | frames again after |\n|---|---|---|---|---|")
    for trouble in TROUBLES:
        settings = CameraSettings(str(pictures), rate_hz=SLOW_HZ, buffer_frames=20)
        rig = VirtualCameras([settings], usbfs_memory_mb=64)
        driver = Driver(rig, f"usb0?rate={SLOW_HZ:g}&transfer_kib=256&silence_s=1")
        try:
            driver.wait_for_frames(1000)
            trouble.happen(rig)
            rig.wait_for(lambda report: bool(report.done))
            if trouble.lost_state:
                driver.wait_for_state("lost")
                driver.wait_for_state("streaming", after=[state for state, _ in driver.observed.states].index("lost"))
            driver.wait_for_frames(1000)
            observed = driver.stop()
        finally:
            driver.close()
            rig.close()
        states = [state for state, _ in observed.states]
        again = "at once"
        if trouble.lost_state:
            lost_s = observed.times["lost"][0]
            again_s = next(at for at in observed.times["streaming"] if at > lost_s) - lost_s
            noticed_s = 1.0 if "silence" in trouble.name else 0.0
            again = f"{1e3 * max(0.0, again_s - (trouble.lasts_s - noticed_s)):.0f} ms"
            states = states[states.index("lost") :]
        else:
            states = []
        causes = ", ".join(sorted({cause for _, _, cause in observed.gaps})) or "-"
        print(
            f"| {trouble.name} | {observed.lost:,} | {causes} | {' -> '.join(dict.fromkeys(states)) or '-'} | {again} |"
        )


def main() -> None:
    """Measure what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", choices=("throughput", "losses", "faults"))
    parser.add_argument("--seconds", type=float, default=600.0, help="length of the capture of `losses`")
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as folder:
        pictures = Path(folder) / "noise.dat"
        np.random.default_rng(3).integers(0, 256, (2000, USB_COMPACT_BYTES), np.uint8).tofile(pictures)
        match arguments.table:
            case "throughput":
                throughput(pictures)
            case "losses":
                losses(pictures, arguments.seconds)
            case "faults":
                faults(pictures)


if __name__ == "__main__":
    main()
