"""`spiked serve`: the daemon."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Annotated

import typer

from spiked.recon import State
from spiked_service.captures import Captures, unhurried
from spiked_service.commands.fault_flags import Corrupt, Drop, Gap, Stall, UnplugAt, with_faults
from spiked_service.config import LogFormat, LogLevel, setting
from spiked_service.console import output
from spiked_service.daemon import Daemon
from spiked_service.geometry import parse_intrinsics
from spiked_service.live import LiveSettings
from spiked_service.memory import limit_arenas
from spiked_service.snapshot import Snapshot
from spiked_service.store.rows import CaptureState, Plan

_FOLLOW_S = 2.0


def serve(
    device: Annotated[
        list[str] | None, typer.Option("--device", "-d", help="replay:FILE or sim:, with options; may be repeated.")
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen at; beyond loopback it needs tokens.")] = None,
    port: Annotated[int | None, typer.Option(help="Port, 8650 if not given; 0 takes a free one.")] = None,
    token: Annotated[str | None, typer.Option(help="A token; `spiked token create` makes better ones.")] = None,
    capture: Annotated[bool, typer.Option("--capture/--no-capture", help="Start with the first device.")] = True,
    frames: Annotated[int | None, typer.Option(help="Length of that capture.", min=1)] = None,
    intrinsics: Annotated[str | None, typer.Option(help="Its optics: fx,fy,cx,cy in pixels.")] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Print how the reconstruction grows.")] = False,
    data: Annotated[Path | None, typer.Option(help="Folder of catalogue and recordings.")] = None,
    runtime: Annotated[Path | None, typer.Option(help="Folder for running captures.")] = None,
    zmq: Annotated[bool | None, typer.Option("--zmq/--no-zmq", help="Events over ZeroMQ, too.")] = None,
    log_level: Annotated[LogLevel | None, typer.Option(help="Least important line written.")] = None,
    log_format: Annotated[LogFormat | None, typer.Option(help="For people or for programs.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file instead of the usual ones.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="NAME=VALUE for any other setting; see `spiked config show`.")
    ] = None,
    drop: Drop = None,
    gap: Gap = None,
    corrupt: Corrupt = None,
    unplug_at: UnplugAt = None,
    stall: Stall = None,
) -> None:
    """Run the daemon: acquisition, reconstruction in a worker process, HTTP and a page to watch it.

    A simulated camera or a replay waits for the reconstruction, so nothing is lost; `?pace=1` plays it as live.
    Every setting can also be given as `SPIKED_NAME`, or in a TOML file.

    Examples:

    - `spiked serve --device sim:`

    - `spiked serve --device 'replay:rec.dat?pace=1' --port 9000`

    - `spiked serve --device 'sim:?pace=1' --drop 0.01 --unplug-at 20000:2s`

    - `spiked token create laptop; spiked serve --device sim: --host 0.0.0.0`
    """
    flags: dict[str, object] = {
        "devices": with_faults(device or [], drop=drop, gap=gap, corrupt=corrupt, unplug_at=unplug_at, stall=stall)
        or None,
        "host": host,
        "port": port,
        "token": token,
        "data": data,
        "runtime": runtime,
        "zmq": zmq,
        "log_level": log_level,
        "log_format": log_format,
    }
    given = dict(setting(text) for text in set_ or []) | {k: v for k, v in flags.items() if v is not None}
    limit_arenas()
    settings = LiveSettings(given, config)
    devices = settings.now.devices
    with Daemon(settings) as daemon:
        captures = daemon.services.captures
        if devices and capture:
            k = parse_intrinsics(intrinsics) if intrinsics else None
            captures.start(Plan(unhurried(devices[0]), frames=frames, intrinsics=k))
        output.print(f"spiked listens at {daemon.address}", markup=False)
        with _followed(captures) if follow else nullcontext():
            daemon.run()


@contextmanager
def _followed(captures: Captures) -> Iterator[None]:
    """Print a line whenever something has changed."""
    over = threading.Event()

    def follow() -> None:
        last = ""
        while not over.wait(_FOLLOW_S):
            for row in captures.list(limit=1).items:
                line = _line(captures.snapshot(row))
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
    row = snapshot.row
    if not snapshot.reconstructions or row.state is CaptureState.FAILED or snapshot.waits_for:
        return f"{row.state}  {snapshot.reason}".rstrip()
    job = snapshot.reconstructions[-1]
    loss = "" if job.loss is None else f"  loss {job.loss:.1e}"
    left = f"  {100 * job.progress:.0f} % refined" if row.state is CaptureState.FINISHING else ""
    growth = f"{job.frames} frames  {job.poses} poses  {job.splats} splats"
    why = "" if job.tracking_state is State.TRACK or not job.reason else f"  ({job.reason})"
    return f"{row.state}  {job.tracking_state}{why}  {growth}{loss}  version {job.version}{left}"
