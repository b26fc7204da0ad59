"""A cell: one method on one recording with one seed, run in a process of its own, measured and scored.

A cell is made in a folder beside its place and moved there when it is complete, so that a killed comparison leaves
whole cells or none. A cell that failed is one, too. It is kept for the recording and truth that it was made of.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ValidationError

from spiked.lifetime import ending_with_this
from spiked_service.base.version import installed_version
from spiked_service.cli.comparison.inputs import GROUND_TRUTH, HELD_OUT, digest_of_inputs
from spiked_service.cli.comparison.rows import TRUTH, Row

RECORD = "cell.json"
RESULT, PICTURES = "result", "pictures"
"""Folders in a cell: what the method wrote, and the held-out views."""
_REASON = 400
"""Characters of a failure's reason."""
_FRAME = " \t│╭╮╰╯─"
"""Around the message about an option that cannot be parsed."""
_POLL_S = 0.02
"""Seconds between two looks at the process."""


class Outcome(BaseModel):
    """What a cell gave."""

    recording: str
    row: str
    seed: int
    command: list[str]
    """Command and options, without those that name files of this machine."""
    reason: str | None = None
    """Why it failed; None for one that did not."""
    seconds: float
    """Wall time of the method, without the scoring."""
    cpu_s: float
    peak_gib: float
    """Largest memory of one of its processes."""
    figures: dict[str, float] = {}
    """Of `spiked evaluate`; empty without a truth."""
    version: str = ""
    inputs: str = ""
    """Digest of the recording and of what lies beside it; empty if they changed meanwhile."""


@dataclass(frozen=True)
class Cell:
    """What is to be run."""

    recording: Path
    name: str
    """Of the recording in the tables."""
    row: Row
    seed: int
    steps: int | None = None
    """Gradient steps; None leaves each method its own number."""

    @property
    def place(self) -> Path:
        """Its folder in that of the comparison."""
        return Path("cells") / self.name / self.row.name / f"seed-{self.seed}"

    @property
    def command(self) -> list[str]:
        """Command and options that define it."""
        words = [*self.row.arguments, "--seed", str(self.seed)]
        if self.steps is None or "--steps" in words:
            return words
        return [*words, "--steps", str(round(self.steps * self.row.share_of_steps))]

    @property
    def truth(self) -> Path | None:
        """The file of true poses, if there is one."""
        path = self.recording.parent / GROUND_TRUTH
        return path if path.exists() else None


def stored(cell: Cell, out: Path) -> Outcome | None:
    """The outcome of an earlier run of the same cell; None if there is none, or its options, recording or truth
    were others. Raises RecordingError."""
    try:
        outcome = Outcome.model_validate_json((out / cell.place / RECORD).read_bytes())
    except (OSError, ValidationError):
        return None
    same = outcome.recording == cell.name and outcome.command == cell.command
    return outcome if same and outcome.inputs == digest_of_inputs(cell.recording) else None


def run_cell(cell: Cell, out: Path, limit_s: float | None = None) -> Outcome:
    """Run, score and store a cell. One that fails or takes longer than `limit_s` has an outcome with a reason.

    Raises RecordingError and OSError.
    """
    place = out / cell.place
    place.parent.mkdir(parents=True, exist_ok=True)
    for left in place.parent.glob(f"{place.name}.making-*"):
        shutil.rmtree(left, ignore_errors=True)
    making = place.with_name(f"{place.name}.making-{os.getpid()}")
    making.mkdir()
    inputs = digest_of_inputs(cell.recording)
    outcome = _outcome(cell, making, limit_s)
    if digest_of_inputs(cell.recording) == inputs:
        outcome = outcome.model_copy(update={"inputs": inputs})
    else:
        changed = "the recording or its truth changed while the cell was made; give the command again"
        outcome = outcome.model_copy(update={"reason": changed})
    (making / RECORD).write_text(outcome.model_dump_json(indent=1), encoding="utf-8")
    old = place.with_name(f"{place.name}.making-old")
    if place.exists():
        place.rename(old)  # not deleted in its place: half of it must not be taken for a cell
    making.rename(place)
    shutil.rmtree(old, ignore_errors=True)
    return outcome


def _outcome(cell: Cell, making: Path, limit_s: float | None) -> Outcome:
    if cell.row.needs_truth and cell.truth is None:
        reason = f"it needs the true poses, and there is no {GROUND_TRUTH} beside the recording"
        return _recorded(cell, _Run(reason, 0, 0, 0))
    command, *options = (str(cell.truth) if word == TRUTH else word for word in cell.command)
    run = _run([command, str(cell.recording), "-o", str(making / RESULT), *options], making / "output.txt", limit_s)
    outcome = _recorded(cell, run)
    if run.reason is not None or cell.truth is None:
        return outcome
    scored = _score(cell, making)
    if isinstance(scored, str):
        return outcome.model_copy(update={"reason": f"it could not be scored: {scored}"})
    return outcome.model_copy(update={"figures": scored})


def _recorded(cell: Cell, run: "_Run") -> Outcome:
    return Outcome(
        recording=cell.name,
        row=cell.row.name,
        seed=cell.seed,
        command=cell.command,
        reason=run.reason,
        seconds=run.seconds,
        cpu_s=run.cpu_s,
        peak_gib=run.peak_gib,
        version=installed_version(),
    )


def _score(cell: Cell, making: Path) -> dict[str, float] | str:
    """The figures, or why there are none."""
    figures = making / "score.json"
    words = ["evaluate", str(making / RESULT), "--recording", str(cell.recording), "--json", str(figures)]
    if (cell.recording.parent / HELD_OUT).exists():
        words += ["--pictures", str(making / PICTURES)]
    run = _run(words, making / "scoring.txt", None)
    if run.reason is not None:
        return run.reason
    found: dict[str, float] = json.loads(figures.read_bytes())
    return found


@dataclass(frozen=True)
class _Run:
    reason: str | None
    seconds: float
    cpu_s: float
    peak_gib: float


def _run(words: list[str], log: Path, limit_s: float | None) -> _Run:
    """Run a command of this program; its output goes to a file. Ends it with this process's own interruption."""
    begin = time.perf_counter()
    with log.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "spiked_service", *words],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | {"TERMINAL_WIDTH": str(2 * _REASON)},
            start_new_session=True,
            preexec_fn=ending_with_this(),  # noqa: PLW1509 - it takes no lock that a thread may hold
        )
    late = False
    try:
        while True:
            found, status, usage = os.wait4(process.pid, os.WNOHANG)
            if found:
                break
            late = late or (limit_s is not None and time.perf_counter() - begin > limit_s)
            if late:
                os.killpg(process.pid, signal.SIGKILL)
            time.sleep(_POLL_S)
    except BaseException:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        raise
    process.returncode = os.waitstatus_to_exitcode(status)
    reason = f"it took more than {limit_s:g} s" if late else _reason(process.returncode, log)
    cpu_s = usage.ru_utime + usage.ru_stime
    return _Run(reason, time.perf_counter() - begin, cpu_s, usage.ru_maxrss / 2**20)


def _reason(status: int, log: Path) -> str | None:
    """What a command that failed said last."""
    if status == 0:
        return None
    text = log.read_text(encoding="utf-8", errors="replace")
    lines = [line for raw in text.splitlines() if (line := raw.strip(_FRAME))]
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    said = (errors or lines or ["no output"])[-1]
    how = f"exit status {status}" if status > 0 else f"killed by {signal.Signals(-status).name}"
    return f"{how}: {said}"[:_REASON]
