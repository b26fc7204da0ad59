"""What may be in flight: enough to hide a busy host, and not more than the kernel lends."""

import re
from pathlib import Path

import pytest
from spiked_driver import usb_budget
from spiked_driver.usb_budget import kernel_bytes, plan_transfers, usbfs_limit

from spiked.errors import SourceError

RATE = 13_016 * 20_000.0
MIB = 1 << 20


def test_by_default_a_quarter_of_a_second_is_hidden() -> None:
    plan = plan_transfers(RATE, None)
    assert 0.25 <= plan.buffered_s < 0.26
    assert plan.transfer_bytes == MIB
    assert plan.note is None


def test_the_kernels_default_takes_fifteen_and_the_note_says_how_to_get_more() -> None:
    plan = plan_transfers(RATE, 16 * MIB)
    assert plan.count == 15
    assert plan.note is not None
    assert "15 transfers of 1024 KiB fit, which hide 60 ms" in plan.note
    assert "usbfs_memory_mb=16" in plan.note
    raised = re.search(r"echo (\d+) \| sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb", plan.note)
    assert raised is not None
    assert plan_transfers(RATE, int(raised[1]) * MIB).note is None


def test_a_stated_buffer_that_does_not_fit_is_refused_with_what_fits() -> None:
    with pytest.raises(SourceError, match=r"to hide \d+ ms .* usbfs_memory_mb=16 .* 15 transfers .* raise it"):
        plan_transfers(RATE, 16 * MIB, buffer_s=0.25)
    assert plan_transfers(RATE, 16 * MIB, buffer_s=0.05).note is None


def test_too_little_for_any_reading_is_refused_even_by_default() -> None:
    with pytest.raises(SourceError, match="2 transfers of 1024 KiB fit"):
        plan_transfers(RATE, 3 * MIB)


@pytest.mark.parametrize("limit", [16, 64, 200])
@pytest.mark.parametrize("size", [16 << 10, 256 << 10, MIB])
def test_a_plan_never_exceeds_the_limit(limit: int, size: int) -> None:
    plan = plan_transfers(RATE, limit * MIB, transfer_bytes=size)
    assert kernel_bytes(plan.count, size) <= limit * MIB


@pytest.mark.parametrize(("text", "limit"), [("16\n", 16 * MIB), ("0\n", None), ("?", None)])
def test_the_limit_is_read_and_zero_is_none(
    text: str, limit: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(usb_budget, "LIMIT_FILE", tmp_path / "usbfs_memory_mb")
    assert usbfs_limit() is None
    (tmp_path / "usbfs_memory_mb").write_text(text)
    assert usbfs_limit() == limit
