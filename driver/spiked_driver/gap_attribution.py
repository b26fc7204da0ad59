"""Gaps of the USB camera: how many frames a break has cost, and whether device or host lost the frames of a gap."""

from dataclasses import dataclass

from spiked.ring import Gap, LossCause
from spiked_driver.framing import USB_FRAME_BYTES, UsbFraming

HELD_FRAMES = 1024
"""Most frames that camera and bridge hold while no read is queued: frames that they drop then follow after those."""
_POSITION_SLACK_FRAMES = 2
"""Frames by which the position of a jump may lie before that of its underrun: a transfer may end within a frame."""
_CLOCK_TOLERANCE = 0.05
"""Share of a break by which the camera's count may differ from the host's clock after a power cycle..."""
_CLOCK_TOLERANCE_S = 1.0
"""... plus this time, seconds: enumeration and the frames in the camera's buffer."""
_ANY_COUNT, _NO_COUNT = 1 << 31, -1
"""Tolerances of `UsbFraming.resume` that always and never trust the camera's counter."""


@dataclass(frozen=True)
class StreamBreak:
    """Why the stream was interrupted, and what happened to the camera in the interruption."""

    cause: LossCause
    power_lost: bool = False
    """It was unplugged: its counters may start anew."""
    swapped: bool = False
    """Another camera took its place: its counters have no relation to the former ones."""


class GapAttribution:
    """Causes and lengths of gaps. Framing sees jumps of the camera's counter; this class knows what the host did.

    A jump is the host's loss (`usb`) if no read was queued at that point of the stream or up to HELD_FRAMES before it.
    Otherwise it is the device's.
    """

    def __init__(self, framing: UsbFraming, rate_hz: float) -> None:
        self._framing = framing
        self._rate_hz = rate_hz
        self._underrun: tuple[int, int] | None = None  # stream positions in bytes: first and last underrun
        self._last_bytes_s = 0.0  # monotonic time of the last bytes

    def underrun(self, waiting_bytes: int) -> None:
        """No read was queued; `waiting_bytes` bytes are complete and not yet fed to the framing."""
        position = self._framing.counters.bytes + waiting_bytes
        self._underrun = (self._underrun[0] if self._underrun else position, position)

    def received(self, size: int, now_s: float, ended: StreamBreak | None) -> None:
        """`size` bytes were received at monotonic time `now_s`, the first ones after the break `ended`.

        Call it before the bytes are fed to the framing.
        """
        if ended is not None:
            missing_s = now_s - self._last_bytes_s
            self._resume(max(0, round(missing_s * self._rate_hz - size / USB_FRAME_BYTES)), ended)
        self._last_bytes_s = now_s

    def attributed(self, gap: Gap) -> Gap:
        """The gap that framing has just returned, with its cause corrected."""
        if self._underrun is None or gap.cause is not LossCause.DEVICE:
            return gap
        first, last = self._underrun
        position = self._framing.counters.position(USB_FRAME_BYTES)
        if position > last + HELD_FRAMES * USB_FRAME_BYTES:
            self._underrun = None
            return gap
        by_host = position > first - _POSITION_SLACK_FRAMES * USB_FRAME_BYTES
        return Gap(gap.first, gap.count, LossCause.USB) if by_host else gap

    def _resume(self, lost: int, ended: StreamBreak) -> None:
        """Pass on the number of frames missing by the host's clock, and how far the camera's counter may differ.

        A camera that kept its power kept its count. One that was unplugged may count anew: its count is used only if
        the clock agrees with it. The count of another camera is never used.
        """
        if ended.swapped:
            tolerance = _NO_COUNT
        elif ended.power_lost:
            tolerance = round(_CLOCK_TOLERANCE_S * self._rate_hz + _CLOCK_TOLERANCE * lost)
        else:
            tolerance = _ANY_COUNT
        self._framing.resume(lost, tolerance, ended.cause)
        self._underrun = None
        if ended.cause is LossCause.USB:  # the camera held frames meanwhile: the jump behind them is the host's, too
            self.underrun(0)
