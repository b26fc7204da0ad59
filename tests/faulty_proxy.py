"""A proxy before an HTTP server of this machine that stalls, refuses and truncates: what networks and stores do."""

import asyncio
import random
import re
import socket
import struct
import threading
from collections import Counter
from contextlib import suppress
from enum import StrEnum

_HEAD_BYTES = 1 << 16
"""Longest head of a request or an answer."""
_CHUNK_BYTES = 1 << 14
"""What is passed on at once."""
_SLOW_DOWN = b"<Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"


class Fault(StrEnum):
    """What becomes of a request."""

    STALL_SENT = "stall sent"
    """Its body is no longer read at some byte."""
    STALL_ANSWER = "stall answer"
    """Its answer stops at some byte, or does not begin."""
    REFUSE = "refuse"
    """The connection is reset."""
    BUSY = "busy"
    """It is answered by 503 SlowDown."""
    TRUNCATE_SENT = "truncate sent"
    """The server gets a part of its body, and then the end."""
    TRUNCATE_ANSWER = "truncate answer"
    """The client gets a part of the answer, and then the end."""


ALL = tuple(Fault)


class FaultyProxy:
    """Passes requests on, one a connection, some with a fault. A context manager; attributes may change at any time."""

    def __init__(self, port: int, seed: int = 0, stall_s: float = 30.0, host: str = "127.0.0.1") -> None:
        """`port` is that of the server, `host` where it seems to be; what is stalled is let go of after `stall_s`."""
        self.share = 0.0
        """Probability of a fault."""
        self.faults: tuple[Fault, ...] = ALL
        """Those that may come."""
        self.path = ""
        """Only requests whose line contains this get a fault."""
        self.happened: Counter[str] = Counter()
        """How many there were."""
        self.requests = 0
        self._server_port = port
        self._random = random.Random(seed)
        self._stall_s = stall_s
        self._serving: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        self._listening = socket.create_server((host, 0), backlog=256)
        self.host, self.port = host, int(self._listening.getsockname()[1])
        self._thread = threading.Thread(target=self._run, name="faulty proxy", daemon=True)

    @property
    def url(self) -> str:
        """Where the server seems to be."""
        return f"http://{self.host}:{self.port}"

    def __enter__(self) -> "FaultyProxy":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(
            asyncio.start_server(self._serve, sock=self._listening, limit=_HEAD_BYTES)
        )
        self._loop.run_forever()
        server.close()
        left = list(self._serving)
        for task in left:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
        self._loop.close()

    def _draw(self, line: bytes) -> Fault | None:
        self.requests += 1
        if self.path.encode() not in line or self._random.random() >= self.share:
            return None
        fault = self._random.choice(self.faults)
        self.happened[fault] += 1
        return fault

    async def _serve(self, client: asyncio.StreamReader, answers: asyncio.StreamWriter) -> None:
        upstream: asyncio.StreamWriter | None = None
        task = asyncio.current_task()
        assert task is not None
        self._serving.add(task)  # or it is garbage while it waits
        try:
            head = await client.readuntil(b"\r\n\r\n")
            fault = self._draw(head.partition(b"\r\n")[0])
            if fault is Fault.REFUSE:
                _reset(answers)
                return
            if fault is Fault.BUSY:
                answers.write(b"HTTP/1.1 503 Slow Down\r\nConnection: close\r\nContent-Type: application/xml\r\n")
                answers.write(b"Content-Length: %d\r\n\r\n" % len(_SLOW_DOWN) + _SLOW_DOWN)
                await answers.drain()
                return
            server, upstream = await asyncio.open_connection("127.0.0.1", self._server_port, limit=_HEAD_BYTES)
            upstream.write(re.sub(rb"(?i)\r\nconnection:[^\r]*", b"", head)[:-2] + b"Connection: close\r\n\r\n")
            sending = asyncio.ensure_future(self._send(client, upstream, _length(head), fault))
            try:
                await self._answer(server, answers, fault)
            finally:
                sending.cancel()
        except asyncio.CancelledError:
            pass  # the proxy ends
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            _reset(answers)  # as the client or the server has done
        finally:
            for writer in (answers, upstream):
                if writer is not None:
                    writer.close()
            self._serving.discard(task)

    async def _send(
        self, client: asyncio.StreamReader, upstream: asyncio.StreamWriter, length: int, fault: Fault | None
    ) -> None:
        """Pass the body of a request on."""
        cut = self._random.randrange(max(length, 1)) if fault in (Fault.STALL_SENT, Fault.TRUNCATE_SENT) else None
        with suppress(OSError):
            await _copy(client, upstream, cut)
            if cut is None:
                upstream.transport.abort()  # the client has gone
            elif fault is Fault.TRUNCATE_SENT:
                upstream.write_eof()

    async def _answer(self, server: asyncio.StreamReader, answers: asyncio.StreamWriter, fault: Fault | None) -> None:
        """Pass the answer on, with what else the server says before it."""
        if fault is Fault.STALL_SENT:
            await asyncio.sleep(self._stall_s)
            return
        head = await server.readuntil(b"\r\n\r\n")
        while head.startswith(b"HTTP/1.1 100"):
            answers.write(head)
            await answers.drain()
            head = await server.readuntil(b"\r\n\r\n")
        cut = None
        if fault in (Fault.STALL_ANSWER, Fault.TRUNCATE_ANSWER):
            # Some before the first byte, the others within the body, which may be empty: that is an answer as any.
            cut = self._random.choice((0, len(head) + self._random.randrange(max(_length(head), 1))))
        passed = head if cut is None else head[:cut]
        answers.write(passed)
        await _copy(server, answers, None if cut is None else cut - len(passed))
        await answers.drain()
        if fault is Fault.STALL_ANSWER:
            await asyncio.sleep(self._stall_s)


async def _copy(source: asyncio.StreamReader, target: asyncio.StreamWriter, most: int | None) -> None:
    """Pass on all that comes, or `most` bytes."""
    while most is None or most > 0:
        content = await source.read(_CHUNK_BYTES if most is None else min(_CHUNK_BYTES, most))
        if not content:
            return
        target.write(content)
        await target.drain()
        most = None if most is None else most - len(content)


def _length(head: bytes) -> int:
    found = re.search(rb"(?i)\r\ncontent-length: *(\d+)", head)
    return int(found.group(1)) if found else 0


def _reset(writer: asyncio.StreamWriter) -> None:
    """Close at once, and say so: not as at the end of an answer."""
    with suppress(OSError):
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    writer.transport.abort()
