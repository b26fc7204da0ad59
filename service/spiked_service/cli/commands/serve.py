"""`spiked serve`: the daemon."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Annotated

import typer

from spiked.recon import State
from spiked_service.base.malloc import limit_arenas
from spiked_service.captures.captures import Captures
from spiked_service.captures.sources import unpaced
from spiked_service.cli.console import output
from spiked_service.cli.fault_flags import Corrupt, Drop, Gap, Stall, UnplugAt, with_faults
from spiked_service.cli.recording_flags import parse_intrinsics
from spiked_service.daemon import Daemon
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.settings import LogFormat, LogLevel, pass_on, setting
from spiked_service.store.rows import CaptureState, Plan
from spiked_service.store.snapshot import Snapshot

_FOLLOW_S = 2.0
"""Interval at which `--follow` checks the newest capture, seconds."""


# Longer than 60 lines, because each option is a parameter.
def serve(
    device: Annotated[
        list[str] | None,
        typer.Option("--device", "-d", help="usb0, pcie:PATH, replay:FILE or sim:, with options; repeatable."),
    ] = None,
    host: Annotated[
        str | None, typer.Option(help="Address to listen on; other than loopback requires a token.")
    ] = None,
    port: Annotated[int | None, typer.Option(help="Port. Default: 8650; 0: any free port.")] = None,
    token: Annotated[
        str | None,
        typer.Option(
            help="A token. Users of this machine see it in the list of processes: better set SPIKED_TOKEN, or give a "
            "file; `spiked token create` makes better ones."
        ),
    ] = None,
    token_file: Annotated[Path | None, typer.Option(help="File that holds a token.")] = None,
    capture: Annotated[
        bool, typer.Option("--capture/--no-capture", help="Start a capture with the first device.")
    ] = True,
    frames: Annotated[int | None, typer.Option(help="Length of that capture in frames.", min=1)] = None,
    intrinsics: Annotated[str | None, typer.Option(help="Optics of that capture: fx,fy,cx,cy in pixels.")] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Print the progress of the reconstruction.")] = False,
    data: Annotated[Path | None, typer.Option(help="Data folder: catalogue, recordings, results.")] = None,
    runtime: Annotated[Path | None, typer.Option(help="Folder for the files of running captures.")] = None,
    zmq: Annotated[bool | None, typer.Option("--zmq/--no-zmq", help="Publish events over ZeroMQ.")] = None,
    log_level: Annotated[LogLevel | None, typer.Option(help="Lowest level that is logged.")] = None,
    log_format: Annotated[LogFormat | None, typer.Option(help="console: text; json: one object per line.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file, instead of the default files.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Any other setting, NAME=VALUE; see `spiked config show`.")
    ] = None,
    drop: Drop = None,
    gap: Gap = None,
    corrupt: Corrupt = None,
    unplug_at: UnplugAt = None,
    stall: Stall = None,
) -> None:
    """Run the daemon: acquisition, recording, reconstruction, REST API and web page.

    Simulated cameras and replays wait for the reconstruction and lose no frames; `?pace=1` plays them in real time.
    Every setting can also be given as the variable `SPIKED_NAME` or in a TOML file.

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
        "token_file": token_file,
        "data": data,
        "runtime": runtime,
        "zmq": zmq,
        "log_level": log_level,
        "log_format": log_format,
    }
    given = dict(setting(text) for text in set_ or []) | {k: v for k, v in flags.items() if v is not None}
    limit_arenas()
    settings = ReloadableSettings(given, config)
    pass_on(settings.now)
    devices = settings.now.devices
    with Daemon(settings) as daemon:
        captures = daemon.services.captures
        if devices and capture:
            k = parse_intrinsics(intrinsics) if intrinsics else None
            captures.start(Plan(unpaced(devices[0]), frames=frames, intrinsics=k))
        output.print(f"spiked listens at {daemon.address}", markup=False)
        with _followed(captures, daemon.services.reconstructions.rows) if follow else nullcontext():
            daemon.run()


@contextmanager
def _followed(captures: Captures, jobs: ReconstructionRepository) -> Iterator[None]:
    """Print the state of the newest capture when it changes."""
    over = threading.Event()

    def follow() -> None:
        last = ""
        while not over.wait(_FOLLOW_S):
            for row in captures.list(limit=1).items:
                line = _line(captures.snapshot(row), jobs)
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


def _line(snapshot: Snapshot, jobs: ReconstructionRepository) -> str:
    """State of a capture, in one line."""
    row = snapshot.row
    if not snapshot.jobs.ids or row.state is CaptureState.FAILED or snapshot.waits_for:
        return f"{row.state}  {snapshot.reason}".rstrip()
    job = jobs.get(snapshot.jobs.ids[-1])
    loss = "" if job.loss is None else f"  loss {job.loss:.1e}"
    left = f"  {100 * job.progress:.0f} % refined" if row.state is CaptureState.FINISHING else ""
    growth = f"{job.frames} frames  {job.poses} poses  {job.splats} splats"
    why = "" if job.tracking_state is State.TRACK or not job.reason else f"  ({job.reason})"
    return f"{row.state}  {job.tracking_state}{why}  {growth}{loss}  version {job.version}{left}"
