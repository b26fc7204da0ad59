"""The order of numbered names."""

from pathlib import Path

from spiked.natural_order import natural


def test_digits_are_numbers() -> None:
    assert sorted(["frame10", "frame2", "a", "3", "frame2b"], key=natural) == ["3", "a", "frame2", "frame2b", "frame10"]


def test_folders_are_numbered_too() -> None:
    first, second = Path("clip9/2.png"), Path("clip10/1.png")
    assert sorted([second, first], key=natural) == [first, second]


def test_digits_that_are_no_numbers_are_text() -> None:
    """A folder named ² once ended `spiked datasets` with a ValueError."""
    assert sorted(["m²", "m1", "²"], key=natural) == ["m1", "m²", "²"]
