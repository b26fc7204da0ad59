"""Ends requests when their token is revoked or expires."""

import asyncio
from collections.abc import Awaitable, Callable

_CHECK_S = 1.0
"""Interval of the checks: the longest time that a stream outlives its token."""


async def while_valid(request: Awaitable[None], valid: Callable[[], bool]) -> bool:
    """Run a request; cancel it when `valid` returns false. Return whether it completed."""
    task, loop = asyncio.current_task(), asyncio.get_running_loop()
    assert task is not None
    cancelled = False
    timer: asyncio.TimerHandle

    def check() -> None:
        nonlocal cancelled, timer
        if valid():
            timer = loop.call_later(_CHECK_S, check)
        else:
            cancelled = task.cancel()

    timer = loop.call_later(_CHECK_S, check)
    try:
        await request
    except asyncio.CancelledError:
        if not cancelled:
            raise
        task.uncancel()
        return False
    finally:
        timer.cancel()
    return True
