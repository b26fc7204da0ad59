"""How many bytes to keep in flight, and whether the kernel lets us."""

from dataclasses import dataclass
from pathlib import Path

from spiked.errors import SourceError

LIMIT_FILE = Path("/sys/module/usbcore/parameters/usbfs_memory_mb")
TRANSFER_BYTES = 1 << 20
MIN_TRANSFERS = 4
"""With fewer the camera has at times nothing to write into, however fast the host is."""
HIDE_S = 0.25
"""How long the host may be busy otherwise, by default, before the camera drops frames."""
_OVERHEAD = 512
"""The kernel's bookkeeping for each piece of 16 KiB of a transfer, at most; it counts against the limit."""
_PIECE_BYTES = 16 << 10


@dataclass(frozen=True)
class TransferPlan:
    """Transfers that are queued at the camera at any time."""

    count: int
    transfer_bytes: int
    rate_bytes: float
    """What the camera sends in a second."""
    note: str | None = None
    """Why it is less than was wanted, and how to get more."""

    @property
    def in_flight_bytes(self) -> int:
        """All of them together."""
        return self.count * self.transfer_bytes

    @property
    def hides_s(self) -> float:
        """How long the host may not look without losing a frame."""
        return self.in_flight_bytes / self.rate_bytes


def usbfs_limit() -> int | None:
    """Bytes that all USB transfers of all processes may have in flight; None if there is no limit, or none to read."""
    try:
        megabytes = int(LIMIT_FILE.read_text())
    except (OSError, ValueError):
        return None
    return megabytes << 20 or None


def kernel_bytes(count: int, transfer_bytes: int) -> int:
    """What the kernel counts for so many transfers, from above."""
    return count * (transfer_bytes + _OVERHEAD * -(-transfer_bytes // _PIECE_BYTES))


def how_to_raise(needed_bytes: int) -> str:
    """What to type so that so many bytes fit."""
    # Twice as much: the limit is for all cameras and programs together.
    megabytes = max(64, 1 << (2 * needed_bytes - 1 >> 20).bit_length())
    return (
        f"raise it with `echo {megabytes} | sudo tee {LIMIT_FILE}`, "
        f"and for good with usbcore.usbfs_memory_mb={megabytes} on the kernel's command line"
    )


def plan_transfers(
    rate_bytes: float,
    limit_bytes: int | None,
    *,
    hide_s: float | None = None,
    transfer_bytes: int = TRANSFER_BYTES,
) -> TransferPlan:
    """Enough transfers to hide `hide_s` (default HIDE_S) of a busy host at that rate.

    What was asked for and does not fit into `limit_bytes` is refused with a SourceError; the default shrinks to what
    fits, with a note.
    """
    wanted = max(MIN_TRANSFERS, -(-round(rate_bytes * (hide_s or HIDE_S)) // transfer_bytes))
    needed = kernel_bytes(wanted, transfer_bytes)
    if limit_bytes is None or needed <= limit_bytes:
        return TransferPlan(wanted, transfer_bytes, rate_bytes)
    fits = limit_bytes // kernel_bytes(1, transfer_bytes)
    what = (
        f"{needed / 2**20:.0f} MiB in flight, to hide {1e3 * wanted * transfer_bytes / rate_bytes:.0f} ms of a busy "
        f"host at {rate_bytes / 1e6:.0f} MB/s, are more than usbfs_memory_mb={limit_bytes >> 20} allows"
    )
    hides_ms = 1e3 * fits * transfer_bytes / rate_bytes
    most = f"{fits} transfers of {transfer_bytes >> 10} KiB fit, which hide {hides_ms:.0f} ms"
    if hide_s is not None or fits < MIN_TRANSFERS:
        raise SourceError(f"{what}; {most}: ask for less, or {how_to_raise(needed)}")
    return TransferPlan(fits, transfer_bytes, rate_bytes, f"{what}; {most}; to get all, {how_to_raise(needed)}")
