"""The bytes of the bridge's session, against the table of facts."""

import struct
from pathlib import Path

import pytest
from spiked_driver import open_camera
from spiked_driver.ft60x import (
    CONFIGURATION_BYTES,
    ChipConfiguration,
    FifoClock,
    FifoMode,
    SessionCommand,
    SessionMode,
    SessionRequests,
)
from spiked_driver.usb import UsbSource

from spiked.errors import SourceError
from spiked.profile import CameraProfile


def configuration(clock: int = 0, mode: int = 0) -> bytes:
    head = struct.pack("<HH128sBBH", 0x0403, 0x601F, b"", 0, 0xE0, 96)
    return head + bytes([0, clock, mode, 2]) + bytes(2 + 1 + 1 + 4 + 4)


def test_session_requests_are_the_twenty_bytes_that_the_bridge_expects() -> None:
    requests = SessionRequests(5)
    assert requests.encode(SessionCommand.READ, 262_144).hex() == "0500000082010000000004000000000000000000"
    assert requests.encode(SessionCommand.ABORT).hex() == "0600000082000000000000000000000000000000"
    assert requests.encode(SessionCommand.STREAM, 1 << 20).hex() == "0700000082020000000010000000000000000000"
    assert requests.encode(SessionCommand.FLUSH).hex() == "0800000082030000000000000000000000000000"


def test_the_number_of_a_request_wraps_around() -> None:
    assert SessionRequests(2**32 + 1).encode(SessionCommand.READ, 1)[:4] == b"\1\0\0\0"


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


def test_a_profile_says_how_the_bridge_is_read_unless_the_source_does(tmp_path: Path) -> None:
    profile = tmp_path / "camera.json"
    CameraProfile(session="stream").write(profile)
    for query, session in (
        ("", SessionMode.STREAM),
        ("&session=request", SessionMode.REQUEST),
        ("&session=auto", None),
    ):
        source = open_camera(f"usb0?profile={profile}{query}").source
        assert isinstance(source, UsbSource) and source.options.session is session
