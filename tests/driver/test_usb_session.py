"""The bytes of the bridge's session, against the table of facts."""

import struct

import pytest
from spiked_driver.ft60x import (
    CONFIGURATION_BYTES,
    READ_REQUEST_BYTES,
    ChipConfiguration,
    FifoClock,
    FifoMode,
    read_request,
)

from spiked.errors import SourceError


def configuration(clock: int = 0, mode: int = 0) -> bytes:
    head = struct.pack("<HH128sBBH", 0x0403, 0x601F, b"", 0, 0xE0, 96)
    return head + bytes([0, clock, mode, 2]) + bytes(2 + 1 + 1 + 4 + 4)


def test_a_read_request_is_the_twenty_bytes_that_the_bridge_expects() -> None:
    assert READ_REQUEST_BYTES == 20
    expected = "0500000082010000000004000000000000000000"
    assert read_request(5, 262_144).hex() == expected


def test_the_request_index_wraps_around() -> None:
    assert read_request(2**32 + 1, 1)[:4] == b"\1\0\0\0"


def test_the_chip_configuration_is_understood() -> None:
    chip = ChipConfiguration.parse(configuration(clock=1, mode=1))
    assert (chip.vendor_id, chip.product_id, chip.power_ma) == (0x0403, 0x601F, 96)
    assert chip.fifo_clock is FifoClock.MHZ_66 and chip.fifo_clock.mhz == 66
    assert chip.fifo_mode is FifoMode.MODE_600


def test_unknown_codes_are_no_error() -> None:
    chip = ChipConfiguration.parse(configuration(clock=9, mode=7))
    assert chip.fifo_clock is None and chip.fifo_mode is None


def test_an_answer_of_another_length_is_an_error_that_says_so() -> None:
    with pytest.raises(SourceError, match=f"100 bytes, not {CONFIGURATION_BYTES}"):
        ChipConfiguration.parse(bytes(100))
