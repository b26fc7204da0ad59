"""Number of queued transfers for a given buffer time, within the kernel's memory limit."""

from dataclasses import dataclass
from pathlib import Path

from spiked.errors import SourceError

LIMIT_FILE = Path("/sys/module/usbcore/parameters/usbfs_memory_mb")
TRANSFER_BYTES = 1 << 20
"""Default size of a bulk transfer."""
MIN_TRANSFERS = 4
"""Least number of transfers: with fewer the camera at times has none to write into, even on a fast host."""
BUFFER_S = 0.25
"""Default time that the host may be busy before the camera drops frames, seconds."""
_OVERHEAD = 512
"""Upper bound of the kernel's own memory for each 16 KiB of a transfer, bytes; it counts against the limit."""
_PIECE_BYTES = 16 << 10
"""Size of usbfs's scatter-gather buffers (drivers/usb/core/devio.c)."""


@dataclass(frozen=True)
class TransferPlan:
    """Transfers that are kept queued at the camera."""

    count: int
    transfer_bytes: int
    rate_bytes: float
    """Bytes a second that the camera sends."""
    note: str | None = None
    """Why it is less than wanted, and how to get more; None if it is not."""

    @property
    def in_flight_bytes(self) -> int:
        """Bytes of all transfers."""
        return self.count * self.transfer_bytes

    @property
    def buffered_s(self) -> float:
        """Seconds that the host may be busy without losing a frame."""
        return self.in_flight_bytes / self.rate_bytes


def usbfs_limit() -> int | None:
    """Limit of the bytes in flight of all processes' USB transfers; None if there is none or it cannot be read."""
    try:
        megabytes = int(LIMIT_FILE.read_text())
    except (OSError, ValueError):
        return None
    return megabytes << 20 or None


def kernel_bytes(count: int, transfer_bytes: int) -> int:
    """Upper bound of the memory that the kernel counts for `count` transfers."""
    return count * (transfer_bytes + _OVERHEAD * -(-transfer_bytes // _PIECE_BYTES))


def how_to_raise(needed_bytes: int) -> str:
    """The commands that raise the limit for `needed_bytes`."""
    # Twice as much: all cameras and programs share the limit.
    megabytes = max(64, 1 << (2 * needed_bytes - 1 >> 20).bit_length())
    return (
        f"raise it with `echo {megabytes} | sudo tee {LIMIT_FILE}`, "
        f"and for good with usbcore.usbfs_memory_mb={megabytes} on the kernel's command line"
    )


def plan_transfers(
    rate_bytes: float,
    limit_bytes: int | None,
    *,
    buffer_s: float | None = None,
    transfer_bytes: int = TRANSFER_BYTES,
) -> TransferPlan:
    """Transfers that buffer `buffer_s` (default BUFFER_S) at `rate_bytes` bytes a second.

    Without `buffer_s`, the plan shrinks to `limit_bytes` and has a note. Raises SourceError if a stated `buffer_s` does
    not fit, or fewer than MIN_TRANSFERS do.
    """
    wanted = max(MIN_TRANSFERS, -(-round(rate_bytes * (buffer_s or BUFFER_S)) // transfer_bytes))
    needed = kernel_bytes(wanted, transfer_bytes)
    if limit_bytes is None or needed <= limit_bytes:
        return TransferPlan(wanted, transfer_bytes, rate_bytes)
    fits = limit_bytes // kernel_bytes(1, transfer_bytes)
    what = (
        f"{needed / 2**20:.0f} MiB in flight, to hide {1e3 * wanted * transfer_bytes / rate_bytes:.0f} ms of a busy "
        f"host at {rate_bytes / 1e6:.0f} MB/s, are more than usbfs_memory_mb={limit_bytes >> 20} allows"
    )
    buffered_ms = 1e3 * fits * transfer_bytes / rate_bytes
    most = f"{fits} transfers of {transfer_bytes >> 10} KiB fit, which hide {buffered_ms:.0f} ms"
    if buffer_s is not None or fits < MIN_TRANSFERS:
        raise SourceError(f"{what}; {most}: request less, or {how_to_raise(needed)}")
    return TransferPlan(fits, transfer_bytes, rate_bytes, f"{what}; {most}; to get all, {how_to_raise(needed)}")
