"""`RunProgress`: how far a refinement is, by steps and by time."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

PROGRESS_STEPS = 50
"""Steps between reports of progress."""


@dataclass
class RunProgress:
    """Steps taken and time spent; both go on after a kill and a new start."""

    done: int = 0
    """Steps taken."""
    spent_s: float = 0.0
    """Time since the first step, without the time between a kill and the next start."""

    def shares(
        self, total: int, deadline: float, cancelled: Callable[[], bool], save: Callable[[], None]
    ) -> Iterator[float]:
        """Before each action the share that is done, 0 to 1: that of `total` steps or of the time, whichever is more.

        Ends with the steps, with the time up to `deadline`, a time of `time.perf_counter`, or when `cancelled`. `save`
        is called before each action: a run saved there goes on with that action.
        """
        begin = time.perf_counter() - self.spent_s
        available_s = max(deadline - begin, 1e-9)
        while self.done < total:
            self.spent_s = time.perf_counter() - begin
            share = max(self.done / total, self.spent_s / available_s)
            save()
            if share >= 1 or cancelled():
                return
            yield share
