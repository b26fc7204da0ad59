"""Rows of ten thousand captures."""

import random
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

from spiked_service.base.ids import new_id
from spiked_service.store.rows import CaptureRow, CaptureState, Grade, Origin, Plan, Quality, Recorded

from spiked.sensor import Sensor

MANY = 10_000
BEGAN = datetime(2026, 1, 1, tzinfo=UTC)
GRADES = (None, Grade.BAD, Grade.DEGRADED, Grade.GOOD)


def many(count: int = MANY) -> Iterator[CaptureRow]:
    """Captures in the order of their start, unlike in all else."""
    dice = random.Random(7)
    for number in range(count):
        frames, rate = dice.randrange(1, 90_000), dice.choice((10_000.0, 20_000.0, 40_000.0))
        grade = dice.choice(GRADES)
        yield CaptureRow(
            new_id(),
            Origin.LIVE,
            Plan(f"sim:?seed={dice.randrange(count)}"),
            CaptureState.COMPLETE,
            BEGAN + timedelta(minutes=number),
            name="" if number % 5 == 0 else f"room {dice.randrange(count):05d}",
            keep=number % 9 == 0,
            sensor=Sensor(400, 250, rate),
            recording=None if number % 11 == 0 else Recorded(frames, frames * dice.randrange(100, 12_500)),
            verdict=None if grade is None else Quality(grade),
        )
