"""A gap is the host's where it queued no read, else the device's; a break has the counter's length or the clock's."""

import numpy as np
import pytest
from spiked_driver.framing import USB_COMPACT_BYTES, USB_FRAME_BYTES, UsbFraming, encode_usb
from spiked_driver.gap_attribution import HELD_FRAMES, GapAttribution, StreamBreak

from spiked.ring import Gap, LossCause

RATE = 1000.0


class Stream:
    """Wire bytes through framing and attribution, as `UsbSource` feeds them."""

    def __init__(self) -> None:
        self.framing = UsbFraming()
        self.attribution = GapAttribution(self.framing, RATE)
        self.gaps: list[Gap] = []
        self._view = np.zeros((64, USB_COMPACT_BYTES), np.uint8)

    def send(
        self, first: int, count: int, *, now_s: float = 0.0, ended: StreamBreak | None = None, lines: int = 0
    ) -> None:
        """Frames `first` to `first + count - 1` of the camera arrive at once."""
        wire = encode_usb(np.zeros((count, USB_COMPACT_BYTES), np.uint8), first=first, lines=lines).tobytes()
        self.attribution.received(len(wire), now_s, ended)
        self.framing.feed(wire)
        while item := self.framing.read_into(self._view):
            if isinstance(item, Gap):
                self.gaps.append(self.attribution.attributed(item))


def test_a_jump_while_reads_are_queued_is_the_loss_of_the_device() -> None:
    stream = Stream()
    stream.send(0, 20)
    stream.send(27, 20)
    assert stream.gaps == [Gap(20, 7, LossCause.DEVICE)]


def test_a_jump_behind_an_underrun_is_the_loss_of_the_host() -> None:
    stream = Stream()
    stream.send(0, 20)
    stream.attribution.underrun(0)
    stream.send(27, 20)
    assert stream.gaps == [Gap(20, 7, LossCause.USB)]


def test_bytes_that_wait_to_be_framed_come_before_the_jump() -> None:
    stream = Stream()
    stream.send(0, 20)
    stream.attribution.underrun(30 * USB_FRAME_BYTES)
    stream.send(20, 10)
    stream.send(35, 30)  # the camera's: the underrun is 20 frames further on
    stream.send(65, 10)
    stream.send(80, 10)
    assert [gap.cause for gap in stream.gaps] == [LossCause.DEVICE, LossCause.USB]


@pytest.mark.parametrize(("held", "cause"), [(HELD_FRAMES - 2, LossCause.USB), (HELD_FRAMES + 2, LossCause.DEVICE)])
def test_a_jump_is_the_host_s_as_far_behind_an_underrun_as_the_camera_can_hold_frames(
    held: int, cause: LossCause
) -> None:
    stream = Stream()
    stream.send(0, 20)
    stream.attribution.underrun(0)
    stream.send(20, held)
    stream.send(20 + held + 5, 20)
    assert stream.gaps == [Gap(20 + held, 5, cause)]


@pytest.mark.parametrize("cause", [LossCause.USB, LossCause.DEVICE])
def test_a_camera_that_kept_its_power_is_counted_by_its_own_counter(cause: LossCause) -> None:
    stream = Stream()
    stream.send(0, 20)
    stream.send(520, 20, now_s=9.0, ended=StreamBreak(cause))
    assert stream.gaps == [Gap(20, 500, cause)]


def test_a_camera_that_counts_anew_is_counted_by_the_clock() -> None:
    stream = Stream()
    stream.send(0, 20)
    stream.send(0, 20, now_s=9.0, ended=StreamBreak(LossCause.DEVICE, power_lost=True), lines=77)
    assert stream.gaps == [Gap(20, 9000 - 20, LossCause.DEVICE)]


def test_a_counter_after_a_power_cycle_is_used_if_the_clock_agrees() -> None:
    stream = Stream()
    stream.send(0, 20)
    stream.send(9500, 20, now_s=9.0, ended=StreamBreak(LossCause.DEVICE, power_lost=True))
    assert stream.gaps == [Gap(20, 9480, LossCause.DEVICE)]


def test_the_counter_of_another_camera_is_not_used() -> None:
    stream = Stream()
    stream.send(0, 20)
    stream.send(9001, 20, now_s=9.0, ended=StreamBreak(LossCause.DEVICE, power_lost=True, swapped=True))
    assert stream.gaps == [Gap(20, 9000 - 20, LossCause.DEVICE)]


def test_a_jump_behind_a_break_by_the_host_is_the_host_s() -> None:
    """The camera held frames while nothing was read; it dropped those that came after them."""
    stream = Stream()
    stream.send(0, 20)
    stream.send(20, 10, now_s=1.0, ended=StreamBreak(LossCause.USB))
    stream.send(900, 20, now_s=1.0)
    assert stream.gaps == [Gap(30, 870, LossCause.USB)]
