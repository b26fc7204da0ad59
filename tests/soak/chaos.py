"""What can go wrong, done on purpose, and what must hold afterwards."""

import json
import mmap
import os
import random
import shutil
import signal
import socket
import sqlite3
import struct
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import msgpack
import psutil
import pytest
import zmq
from waiting import until
from websockets.sync.client import connect

from spiked.recording import Verdict, verify

DEADLINE_S = 180.0
SOURCE = "sim:?width=96&height=64&rate=1000&pace=1"
SHM = Path("/dev/shm")
OVER = ("complete", "failed")


class Clock:
    """The wall clock of the daemon, its workers, and nobody else."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Skips the test where there is no compiler."""
        compiler = shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            pytest.skip("needs a C compiler for a clock that jumps")
        library = folder / "clock.so"
        source = Path(__file__).with_name("clock.c")
        subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
        file = folder / "clock"
        file.write_bytes(bytes(8))
        with file.open("r+b") as opened:
            self._memory = mmap.mmap(opened.fileno(), 8)
        monkeypatch.setenv("LD_PRELOAD", str(library))
        monkeypatch.setenv("CHAOS_CLOCK", str(file))

    def jump_to(self, offset_s: int) -> None:
        """From now on it is wrong by so much."""
        self._memory[:] = struct.pack("q", offset_s)


class Victim:
    """A daemon that is maltreated, started again when it dies, and looked at closely."""

    def __init__(self, start: Callable[[], Any], data: Path, seed: int) -> None:
        self._start = start
        self._data = data
        self.random = random.Random(seed)
        self.daemon = start()
        self.mentioned: list[str] = []
        """What was done, for the message of a test that fails."""

    def capturing(self) -> str:
        """The id of a capture whose frames come; a new one if there is none."""
        items = self.daemon.http.get("captures", params={"limit": 1}).json()["items"]
        if not items or items[0]["state"] in OVER:
            answer = self.daemon.http.post("captures", json={"source": SOURCE, "options": {"steps": 5}})
            assert answer.status_code == 201, answer.text
            capture = answer.json()["id"]
        else:
            capture = items[0]["id"]

        def flows() -> bool:
            now = self.daemon.http.get(f"captures/{capture}").json()
            return now["state"] in OVER or bool(now["counters"] and now["counters"]["received"] > 50)

        until(flows, f"capture {capture} flows")
        return str(capture)

    def do(self, action: str) -> None:
        """One of the methods below, by name."""
        self.mentioned.append(action)
        getattr(self, action)()

    def kill_worker(self) -> None:
        workers = self.daemon.workers()
        if workers:
            role = self.random.choice(sorted(workers))
            self.mentioned[-1] += f" {role}"
            with suppress(psutil.NoSuchProcess):
                workers[role].kill()

    def pause_worker(self) -> None:
        workers = self.daemon.workers()
        if workers:
            role = self.random.choice(sorted(workers))
            self.mentioned[-1] += f" {role}"
            with suppress(psutil.NoSuchProcess):
                workers[role].suspend()
                time.sleep(0.3)
                workers[role].resume()

    def kill_daemon(self) -> None:
        workers = list(self.daemon.workers().values())
        self.daemon.process.send_signal(signal.SIGKILL)
        self.daemon.process.wait()
        assert psutil.wait_procs(workers, 10)[1] == [], "workers outlived their daemon"
        self.daemon = self._start()

    def restart_daemon(self) -> None:
        self.daemon.process.terminate()
        assert self.daemon.process.wait(30) == 0
        self.daemon = self._start()

    def stop_capture(self) -> None:
        capture = self.capturing()
        for _ in range(2):
            assert self.daemon.http.post(f"captures/{capture}:stop").status_code in (200, 202, 409)

    def rude_websocket(self) -> None:
        host, port = self._address()
        handshake = f"GET /api/v1/events HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        handshake += "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        for _ in range(5):
            with suppress(OSError), socket.create_connection((host, port), timeout=5) as rude:
                rude.sendall(handshake.encode() + self.random.randbytes(200))

    def rude_http(self) -> None:
        host, port = self._address()
        for _ in range(5):
            with suppress(OSError), socket.create_connection((host, port), timeout=5) as rude:
                rude.sendall(self.random.choice([b"GET /", b"POST /api/v1/captures HTTP/1.1\r\n", b"\x16\x03\x01"]))
                rude.sendall(self.random.randbytes(300))

    def rude_zmq(self) -> None:
        addresses = self.daemon.http.get("system").json()["zmq"]
        for address in addresses.values():
            port = int(address.rpartition(":")[2])
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=5) as rude:
                rude.sendall(b"\xff\0\0\0\0\0\0\0\1\x7f\3\0NULL" + self.random.randbytes(300))
        with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
            dealer.set(zmq.LINGER, 0)
            dealer.connect(addresses["state"])
            for _ in range(20):
                dealer.send_multipart([b"", self.random.randbytes(self.random.randrange(100))])
                dealer.send_multipart([self.random.randbytes(10)])

    def slow_reader(self) -> None:
        host, port = self._address()
        with connect(f"ws://{host}:{port}/api/v1/events", compression=None, max_queue=1):
            time.sleep(0.5)

    def _address(self) -> tuple[str, int]:
        url = httpx.URL(self.daemon.address)
        assert url.port is not None
        return url.host, url.port

    def check(self) -> None:
        """What must hold whatever was done."""
        assert self.daemon.process.poll() is None, "the daemon died"
        told = until(self._ready, "the service is ready")
        assert told["status"] != "failed"
        addresses = self.daemon.http.get("system").json()["zmq"]
        assert "messages" in ask(addresses["state"])
        for capture in self.captures():
            self._check_capture(capture)
        with sqlite3.connect(f"file:{self._data / 'catalogue.sqlite'}?mode=ro", uri=True) as catalogue:
            assert catalogue.execute("PRAGMA integrity_check").fetchone() == ("ok",)

    def captures(self) -> list[dict[str, Any]]:
        return list(self.daemon.http.get("captures", params={"limit": 200}).json()["items"])

    def check_at_rest(self) -> None:
        """When all captures and jobs are over: no process, no memory and no half-written file is left."""
        for capture in self.captures():
            if capture["state"] not in OVER:
                for _ in range(2):
                    self.daemon.http.post(f"captures/{capture['id']}:stop")
        until(lambda: all(capture["state"] in OVER for capture in self.captures()), "all captures are over")
        self._work_off()
        until(lambda: not self.daemon.workers(), "no worker is left")
        for capture in self.captures():
            assert not (SHM / f"spiked-{capture['id']}").exists()
            self._check_recording(capture)
        for file in self._data.glob("reconstructions/*/published.json"):
            json.loads(file.read_text())
        self.check()

    def _work_off(self) -> None:
        """Wait for all jobs, however many were begun again, as long as one of them gets on."""
        last, since_s = None, time.monotonic()
        while True:
            jobs = self.daemon.http.get("reconstructions", params={"limit": 200}).json()["items"]
            left = [job for job in jobs if job["state"] in ("queued", "running")]
            if not left:
                return
            now = [(job["id"], job["state"], job["stage"], job["frames"], job["progress"]) for job in left]
            if now != last:
                last, since_s = now, time.monotonic()
            assert time.monotonic() - since_s < DEADLINE_S, f"no job gets on: {left}\n{self.logs()}"
            time.sleep(0.2)

    def logs(self) -> str:
        """The ends of the logs of all jobs, which go with the disk."""
        logs = sorted(self._data.glob("reconstructions/*/log"))
        return "\n".join(f"{log}:\n{log.read_text(errors='replace')[-4000:]}" for log in logs)

    def _ready(self) -> Any:
        with suppress(httpx.HTTPError):
            answer = httpx.get(f"{self.daemon.address}readyz", timeout=10)
            return answer.status_code == 200 and answer.json()
        return None

    def _check_capture(self, capture: dict[str, Any]) -> None:
        counters = capture["counters"]
        if counters:
            assert counters["received"] + sum(counters["lost"].values()) == counters["next_frame"], capture
        if capture["state"] in OVER:
            assert capture["ended_at"], capture

    def _check_recording(self, capture: dict[str, Any]) -> None:
        """It is whole up to its last block, and what the catalogue says of it is true."""
        path = self._data / "captures" / capture["id"] / "recording.dat"
        if capture["recording"] and capture["recording"]["frames"]:
            found = verify(path)
            assert found.recording.frames == capture["recording"]["frames"], (capture, found)
            assert found.verdict is not Verdict.BAD, found


def ask(address: str) -> dict[str, Any]:
    """The state over ZeroMQ."""
    with zmq.Context() as context, context.socket(zmq.REQ) as socket_:
        socket_.set(zmq.LINGER, 0)
        socket_.set(zmq.RCVTIMEO, 10_000)
        socket_.connect(address)
        socket_.send(msgpack.packb({"get": "state"}))
        return dict(msgpack.unpackb(socket_.recv()))


def fill(folder: Path, leave_bytes: int) -> Path:
    """A file that takes what is free on the disk."""
    stat = os.statvfs(folder)
    file = folder / "filling"
    with file.open("wb") as opened:
        os.posix_fallocate(opened.fileno(), 0, max(1, stat.f_bavail * stat.f_frsize - leave_bytes))
    return file
