"""`spiked serve`: the daemon."""

import ipaddress
import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer
import uvicorn

from spiked.errors import ConfigurationError
from spiked.recon import State
from spiked_service.api import create_app
from spiked_service.capture import CaptureState, Plan, Snapshot
from spiked_service.captures import Captures, unhurried
from spiked_service.console import output
from spiked_service.geometry import parse_intrinsics
from spiked_service.runtime import RuntimeFolder

_FOLLOW_S = 2.0


def serve(
    device: Annotated[
        list[str] | None, typer.Option("--device", "-d", help="replay:FILE or sim:, with options; may be repeated.")
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen at; beyond loopback it needs --token.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port; 0 takes a free one.", min=0, max=65535)] = 8650,
    token: Annotated[
        str | None, typer.Option(envvar="SPIKED_TOKEN", help="What every request must bring.", show_envvar=True)
    ] = None,
    capture: Annotated[bool, typer.Option("--capture/--no-capture", help="Start with the first device.")] = True,
    frames: Annotated[int | None, typer.Option(help="Length of that capture.", min=1)] = None,
    intrinsics: Annotated[str | None, typer.Option(help="Its optics: fx,fy,cx,cy in pixels.")] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Print how the reconstruction grows.")] = False,
    runtime: Annotated[
        Path | None, typer.Option(envvar="SPIKED_RUNTIME", help="Folder for running captures.", show_envvar=True)
    ] = None,
) -> None:
    """Run the daemon: acquisition, reconstruction in a worker process, HTTP and a page to watch it.

    A simulated camera or a replay waits for the reconstruction, so nothing is lost; `?pace=1` plays it as live.

    Examples:

    - `spiked serve --device sim:`

    - `spiked serve --device 'replay:rec.dat?pace=1' --port 9000`

    - `SPIKED_TOKEN=secret spiked serve --device sim: --host 0.0.0.0`
    """
    _check_access(host, token)
    devices = device or []
    plan = None
    if devices and capture:
        k = parse_intrinsics(intrinsics) if intrinsics else None
        plan = Plan(unhurried(devices[0]), frames=frames, intrinsics=k)
    listener = _listen(host, port)
    folder = RuntimeFolder(runtime)
    captures = Captures(folder.path)
    config = uvicorn.Config(
        create_app(captures, devices, token), log_level="warning", lifespan="on", timeout_graceful_shutdown=1
    )
    try:
        if plan is not None:
            captures.start(plan)
        output.print(f"spiked listens at http://{_shown(host)}:{listener.getsockname()[1]}/", markup=False)
        with _followed(captures) if follow else nullcontext():
            _Server(config, captures).run(sockets=[listener])
    finally:
        captures.close()
        folder.remove()


class _Server(uvicorn.Server):
    """Leaves with exit code 0 after SIGINT and SIGTERM: both are ways to end a daemon."""

    def __init__(self, config: uvicorn.Config, captures: Captures) -> None:
        super().__init__(config)
        self._captures = captures

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """The workers learn of the end at once, not when the last response is sent."""
        threading.Thread(target=self._captures.dismiss, name="dismissal").start()
        super().handle_exit(sig, frame)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """As uvicorn does, but without dying of the signal afterwards, which would leave the runtime folder behind."""
        before = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _check_access(host: str, token: str | None) -> None:
    """Raises ConfigurationError for an address that others can reach without a token."""
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = host == "localhost"
    if not loopback and not token:
        raise ConfigurationError(f"--host {host} can be reached by others: give a --token that requests must bring")


def _listen(host: str, port: int) -> socket.socket:
    """A listening socket, so that the address is known before anything is started. Raises ConfigurationError."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except OSError as error:
        why = str(error) if error.errno is None or error.errno < 0 else os.strerror(error.errno)
        raise ConfigurationError(f"cannot listen at {host}:{port}: {why}; choose another --host or --port") from error


def _shown(host: str) -> str:
    return f"[{host}]" if ":" in host else host


@contextmanager
def _followed(captures: Captures) -> Iterator[None]:
    """Print a line whenever something has changed."""
    over = threading.Event()

    def follow() -> None:
        last = ""
        while not over.wait(_FOLLOW_S):
            for capture in captures.all()[-1:]:
                line = _line(capture.snapshot())
                if line != last:
                    output.print(line, markup=False)
                    last = line

    thread = threading.Thread(target=follow, name="follow")
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _line(snapshot: Snapshot) -> str:
    """How a capture stands, in one line."""
    status = snapshot.reconstruction
    if status is None or snapshot.state is CaptureState.FAILED:
        return f"{snapshot.state}  {snapshot.reason}".rstrip()
    loss = "" if status.loss is None else f"  loss {status.loss:.1e}"
    left = f"  {100 * status.progress:.0f} % refined" if snapshot.state is CaptureState.FINISHING else ""
    growth = f"{status.frames} frames  {status.poses} poses  {status.splats} splats"
    why = "" if status.state is State.TRACK or not status.reason else f"  ({status.reason})"
    return f"{snapshot.state}  {status.state}{why}  {growth}{loss}  version {status.version}{left}"
