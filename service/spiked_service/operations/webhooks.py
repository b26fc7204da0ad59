"""Tells other programs by HTTP when jobs have ended."""

import queue
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress

import httpx

from spiked_service.events.bus import Bus, Message, Topic
from spiked_service.events.logging import logger
from spiked_service.store.rows import JobState

__all__ = ["Webhooks"]

TIMEOUT_S = 10.0
"""For an answer."""
DELAYS_S = (1.0, 5.0, 25.0)
"""Before an address that did not answer with 2xx is tried again."""
REMEMBERED = 1024
"""Jobs whose end was told: a job that is over may change again."""
_log = logger("spiked.webhooks")


class Webhooks:
    """Sends the message of a job that has ended to addresses. Nothing waits for it.

    One thread picks such messages from all of the bus, and another sends them: an address that does not answer takes
    longer than the bus keeps messages.
    """

    def __init__(self, bus: Bus, addresses: Callable[[], Sequence[str]], delays_s: Sequence[float] = DELAYS_S) -> None:
        """`addresses` are those of now."""
        self._addresses = addresses
        self._delays_s = delays_s
        self._subscription = bus.subscribe([Topic.JOB])
        self._told: OrderedDict[tuple[str | None, object], None] = OrderedDict()
        self._leave = threading.Event()
        self._ended: queue.Queue[Message | None] = queue.Queue(REMEMBERED)
        self._threads = [
            threading.Thread(target=work, name=f"webhooks {name}", daemon=True)
            for name, work in (("picking", self._pick), ("sending", self._send_all))
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the threads; what is being sent is given up."""
        self._leave.set()
        self._subscription.close()
        with suppress(queue.Full):
            self._ended.put_nowait(None)
        for thread in self._threads:
            thread.join(TIMEOUT_S)

    def _pick(self) -> None:
        while not self._leave.is_set():
            message = self._subscription.take(1.0)
            if message is None or message.topic is not Topic.JOB or not self._ends(message):
                continue
            try:
                self._ended.put_nowait(message)
            except queue.Full:
                _log.error("webhook dropped: too many wait to be sent", job=message.reconstruction_id)

    def _send_all(self) -> None:
        while not self._leave.is_set():
            if (message := self._ended.get()) is not None:
                for address in self._addresses():
                    self._send(address, message)

    def _ends(self, message: Message) -> bool:
        """Whether it tells the end of a job for the first time."""
        job = message.payload.model_dump()
        key = (message.reconstruction_id, job["ended_at"])
        if not JobState(job["state"]).over or key in self._told:
            return False
        self._told[key] = None
        if len(self._told) > REMEMBERED:
            self._told.popitem(last=False)
        return True

    def _send(self, address: str, message: Message) -> None:
        trouble = ""
        for delay_s in (0.0, *self._delays_s):
            if self._leave.wait(delay_s):
                return
            try:
                answer = httpx.post(
                    address,
                    content=message.json,
                    headers={"content-type": "application/json", "x-spiked-event": "job"},
                    timeout=TIMEOUT_S,
                    follow_redirects=False,
                    trust_env=False,
                )
                if answer.is_success:
                    return
                trouble = f"it answered {answer.status_code}"
            except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:
                trouble = str(error) or type(error).__name__
        _log.warning("webhook not delivered", address=address, job=message.reconstruction_id, reason=trouble)
