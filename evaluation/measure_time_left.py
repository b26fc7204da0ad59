"""Compare the time that a reconstruction says it has left with the time that it then takes.

    .venv/bin/python evaluation/measure_time_left.py RECORDING.dat [--steps N]

The table has the predictions at tenths of the whole; the last line the worst from a fifth of the way on, as a share of
the time that was left, up to 95 %: after that a second is too large a part of what is left. Writing the results is not
included. Other programs that come and go on the same cores make errors that no prediction can know.
"""

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path

from spiked_service.results.recording_feed import reconstruct_recording

from spiked.recon import Options, Reconstructor, Status
from spiked.recording import open_recording

FIRST, LAST = 0.2, 0.95
"""Shares of the time between which predictions count."""


@dataclass(frozen=True)
class Told:
    """A prediction."""

    at_s: float
    left_s: float | None
    stage: str


def told(recording: Path, steps: int) -> tuple[list[Told], float]:
    """Reconstruct; returns the predictions and the seconds of the whole."""
    opened = open_recording(recording)
    reconstructor = Reconstructor(opened.sensor, Options(steps=steps), recording=opened)
    out: list[Told] = []
    begin = time.perf_counter()

    def note(status: Status) -> None:
        ending = status.frames == opened.frames and status.stage == "tracking"
        stage = "ending" if ending else status.stage
        out.append(Told(time.perf_counter() - begin, status.left_s, stage))

    reconstruct_recording(opened, reconstructor, progress=note, cancelled=lambda: False)
    return out, time.perf_counter() - begin


def error(one: Told, whole_s: float) -> float:
    """Relative error of a prediction."""
    return math.inf if one.left_s is None else one.left_s / (whole_s - one.at_s) - 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--steps", type=int, default=Options.steps)
    given = parser.parse_args()
    found, whole_s = told(given.recording, given.steps)
    print(f"{given.recording.name}: {whole_s:.1f} s")
    print("| share of the time | stage | left, predicted s | left, true s | error % |\n|---|---|---|---|---|")
    for tenth in range(1, 10):
        one = next((one for one in found if one.at_s >= tenth / 10 * whole_s), found[-1])
        said = "-" if one.left_s is None else f"{one.left_s:.1f}"
        share, wrong = one.at_s / whole_s, 100 * error(one, whole_s)
        print(f"| {share:.2f} | {one.stage} | {said} | {whole_s - one.at_s:.1f} | {wrong:+.0f} |")
    counted = [one for one in found if FIRST <= one.at_s / whole_s <= LAST]
    worst = max(counted, key=lambda one: abs(error(one, whole_s)))
    within = sum(abs(error(one, whole_s)) <= 0.25 for one in counted) / len(counted)
    print(
        f"worst from {FIRST:.0%} to {LAST:.0%}: {100 * error(worst, whole_s):+.0f} % at {worst.at_s / whole_s:.2f} "
        f"({worst.stage}); within 25 %: {within:.1%} of {len(counted)}"
    )


if __name__ == "__main__":
    main()
