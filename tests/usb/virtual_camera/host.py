"""The machine with cameras: serves a test bed's device nodes and does what its standard input says, line by line."""

import json
import os
import selectors
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .core import Bridge, Camera
from .descriptors import Identity, Speed
from .faults import Fault, Kind
from .stream import COMPACT_BYTES, MAGIC, Stream
from .testbed import Testbed
from .usbfs import Client, Limits, Node

SHORTEST_WAIT_S = 20e-6
"""A frame is late by at most so much because the loop sleeps."""


@dataclass(frozen=True)
class CameraSettings:
    """A camera, and how it behaves; what a test passes as JSON."""

    frames: str
    """File of compact frames, played over and over."""
    rate_hz: float = 0.0
    """0: as fast as it is read, and nothing is dropped."""
    serial: str = "000000000001"
    port: str = "2-1"
    usb2: bool = False
    plugged: bool = True
    mode: int = 0o666
    """Permissions of the device node."""
    lines: int = 0
    nbytes: int = 0
    buffer_frames: int = 64
    stamp: bool = True
    fifo: bool = False
    """Without room the oldest frames are kept, not the newest."""
    magic: int = MAGIC
    """First word of each header."""
    chip: tuple[int, int, int] = (0, 0, 2)
    """The bridge's codes for clock, FIFO mode and channels."""
    faults: tuple[Fault, ...] = ()
    bridge: Bridge = Bridge.ALL

    def build(self) -> Camera:
        """The camera."""
        frames = np.fromfile(self.frames, np.uint8).reshape(-1, COMPACT_BYTES)
        stream = Stream(
            frames,
            rate_hz=self.rate_hz,
            lines=self.lines,
            nbytes=self.nbytes,
            buffer_frames=self.buffer_frames,
            stamp=self.stamp,
            fifo=self.fifo,
            magic=self.magic,
            faults=self.faults,
        )
        identity = Identity(serial=self.serial, chip=tuple(self.chip))  # type: ignore[arg-type]
        return Camera(stream, identity, Speed.HIGH if self.usb2 else Speed.SUPER, Bridge(self.bridge))


def settings_from(values: dict[str, Any]) -> CameraSettings:
    """The settings that JSON says."""
    faults = tuple(fault_from(fault) for fault in values.pop("faults", ()))
    return CameraSettings(**values, faults=faults)


def fault_from(values: dict[str, Any]) -> Fault:
    """The fault that JSON says."""
    return Fault(**{**values, "kind": Kind(values["kind"])})


class Socketed:
    """A camera of the host: at a port, or not."""

    def __init__(self, settings: CameraSettings, host: "Host") -> None:
        self.camera = settings.build()
        self.port = settings.port
        self.mode = settings.mode
        self.node: Node | None = None
        self.plugs = 0
        self._host = host
        self._syspath = ""
        self._fifo = Path()
        self.listener: socket.socket | None = None
        """Where clients of the node come."""
        self._old: list[Node] = []
        if settings.plugged:
            self.plug(self.port)

    def plug(self, port: str) -> None:
        """Come to a port, as a device that was just switched on."""
        if self.node is not None:
            raise ValueError("the camera is plugged in already")
        if self.plugs:
            self.camera.stream.power_on(lines=1000 * self.plugs, nbytes=77 * self.plugs)
        self.plugs += 1
        self.port = port
        self._syspath, self._fifo, self.listener = self._host.testbed.plug(self.camera, port, self.mode)
        self.node = Node(self.camera, str(self._fifo), self._host.limits, self._fault)
        self._host.selector.register(self.listener, selectors.EVENT_READ, self.accept)

    def unplug(self) -> None:
        """Go."""
        if self.node is None or self.listener is None:
            raise ValueError("the camera is not plugged in")
        self._host.selector.unregister(self.listener)
        self.listener.close()
        self.node.unplug()
        self._old.append(self.node)
        self.node = None
        self._host.testbed.unplug(self._syspath, self._fifo)

    def permit(self, mode: int) -> None:
        """Change the permissions of the node."""
        self.mode = mode
        self._fifo.chmod(mode)

    def _fault(self, fault: Fault) -> None:
        """The stream says that the camera is pulled out now."""
        self.unplug()
        if fault.seconds:
            port = fault.port or self.port
            self._host.later(fault.seconds, lambda: self.plug(port))

    def accept(self) -> None:
        """A client opens the node."""
        assert self.listener is not None
        node = self.node
        assert node is not None
        client = Client(self.listener.accept()[0], node)
        node.clients.append(client)

        def serve() -> None:
            try:
                client.serve()
            except ConnectionError:
                self._host.selector.unregister(client.connection)
                client.connection.close()
                node.clients.remove(client)
            node.pump()

        self._host.selector.register(client.connection, selectors.EVENT_READ, serve)

    def close(self) -> None:
        """Let go of the nodes."""
        for node in (*self._old, *([self.node] if self.node else [])):
            node.close()


class Elsewhere:
    """A camera of the host that another process serves. It stays plugged in."""

    def __init__(self, commands: socket.socket) -> None:
        self._commands = commands
        self._answers = commands.makefile("r")

    def ask(self, command: dict[str, Any]) -> dict[str, Any]:
        """What the camera's process answers."""
        if command["do"] in ("plug", "unplug"):
            raise ValueError("a camera with a process of its own stays plugged in")
        self._commands.sendall((json.dumps(command) + "\n").encode())
        answer: dict[str, Any] = json.loads(self._answers.readline())
        return answer

    def close(self) -> None:
        """End the camera's process."""
        self._answers.close()
        self._commands.close()
        os.wait()


class Host:
    """Cameras at one test bed, and the loop that serves them."""

    def __init__(self, cameras: list[CameraSettings], limits: Limits, usbfs_memory_mb: int) -> None:
        self.selector = selectors.SelectSelector()  # in microseconds; epoll's timeout is rounded up to a millisecond
        self.testbed = Testbed(usbfs_memory_mb)
        self.limits = limits
        self._timers: list[tuple[float, Callable[[], None]]] = []
        self._sockets: list[Socketed | Elsewhere] = [Socketed(settings, self) for settings in cameras]
        self._commands, self._wake = socket.socketpair()
        self._lines: list[str] = []
        self._over = False
        self.selector.register(self._commands, selectors.EVENT_READ, self._obey)
        threading.Thread(target=self._listen, daemon=True).start()

    def spread(self) -> None:
        """Serve each camera but the first in a process of its own, so that none waits for what another does."""
        for at, socketed in enumerate(self._sockets[1:], 1):
            assert isinstance(socketed, Socketed)
            here, there = socket.socketpair()
            if not os.fork():
                for other in (here, self._commands, self._wake):
                    other.close()
                self._alone(socketed, there)
                os._exit(0)
            there.close()
            if socketed.listener is not None:
                self.selector.unregister(socketed.listener)
            self._sockets[at] = Elsewhere(here)

    def _alone(self, socketed: Socketed, commands: socket.socket) -> None:
        """Serve only this camera, until the other end of `commands` is closed."""
        self.selector = selectors.SelectSelector()
        self._sockets = [socketed]
        if socketed.listener is not None:
            self.selector.register(socketed.listener, selectors.EVENT_READ, socketed.accept)

        def obey() -> None:
            line = commands.makefile("r").readline()
            if line:
                commands.sendall((json.dumps(self._answer(json.loads(line))) + "\n").encode())
            else:
                self._over = True

        self.selector.register(commands, selectors.EVENT_READ, obey)
        self._serve()

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something after a while."""
        self._timers.append((time.monotonic() + seconds, action))

    def run(self) -> None:
        """Serve until standard input ends."""
        self._serve()
        for each in self._sockets:
            each.close()
        self.testbed.close()

    def _serve(self) -> None:
        while not self._over:
            for key, _ in self.selector.select(self._timeout()):
                key.data()
            for node in self._nodes():
                node.pump()
            now_s = time.monotonic()
            due = [timer for timer in self._timers if timer[0] <= now_s]
            self._timers = [timer for timer in self._timers if timer[0] > now_s]
            for _, action in due:
                action()

    def _nodes(self) -> list[Node]:
        return [each.node for each in self._sockets if isinstance(each, Socketed) and each.node is not None]

    def _timeout(self) -> float | None:
        now_s = time.monotonic()
        waits = [timer[0] - now_s for timer in self._timers]
        waits += [wait for node in self._nodes() if (wait := node.wait_s(now_s)) is not None]
        return max(SHORTEST_WAIT_S, min(waits)) if waits else None

    def _listen(self) -> None:
        for line in sys.stdin:
            self._lines.append(line)
            self._wake.send(b"\n")
        self._wake.close()

    def _obey(self) -> None:
        if not self._commands.recv(1):
            self._over = True
            return
        command = json.loads(self._lines.pop(0))
        print(json.dumps(self._answer(command)), flush=True)

    def _answer(self, command: dict[str, Any]) -> dict[str, Any]:
        socketed = self._sockets[command.pop("camera", 0)]
        try:
            if isinstance(socketed, Elsewhere):
                return socketed.ask(command)
            return self._do(socketed, **command)
        except Exception as error:  # the test is told, and the cameras stay
            return {"error": f"{type(error).__name__}: {error}"}

    def _do(self, socketed: Socketed, do: str, **values: Any) -> dict[str, Any]:
        stream = socketed.camera.stream
        match do:
            case "plug":
                socketed.plug(values.get("port") or socketed.port)
            case "unplug":
                socketed.unplug()
            case "fault":
                stream.add(fault_from(values))
            case "permit":
                socketed.permit(values["mode"])
            case "report":
                node = socketed.node
                return {
                    "sent": [[run.first, run.count] for run in stream.sent],
                    "next_frame": stream.next_frame,
                    "start_s": stream.start_s,
                    "handed_over": list(stream.handed_over),
                    "dropped": stream.dropped,
                    "done": [asdict(fault) for fault in stream.done],
                    "requests": [asdict(request) for request in socketed.camera.requests],
                    "bad_requests": socketed.camera.bad_requests,
                    "commands": socketed.camera.commands,
                    "in_flight_bytes": node.in_flight_bytes() if node else 0,
                    "room_bytes": node.room_bytes() if node else 0,
                    "plugged": node is not None,
                    "port": socketed.port,
                    "direct_memory": all(client.memory.direct for client in node.clients) if node else None,
                }
            case _:
                raise ValueError(f"no command {do!r}")
        return {}


def main() -> None:
    """Read settings as one line of JSON, say where the test bed is, and serve."""
    settings = json.loads(sys.stdin.readline())
    megabytes = settings.get("usbfs_memory_mb", 16)
    limits = Limits(megabytes << 20 if megabytes else None, settings.get("direct_memory", True))
    host = Host([settings_from(values) for values in settings["cameras"]], limits, megabytes)
    if settings.get("own_processes", False):
        host.spread()
    print(json.dumps({"root": str(host.testbed.root)}), flush=True)
    host.run()


if __name__ == "__main__":
    main()
