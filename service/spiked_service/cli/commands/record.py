"""`spiked record`: captures of one or several devices of a running service, started together."""

import signal
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.live import Live
from rich.table import Table

from spiked.client import CaptureOut, CaptureRequest, CaptureState, Grade, GroupOut, Spiked
from spiked.errors import ConfigurationError
from spiked_service.base.signals import ending_signals, handling
from spiked_service.cli import outputs
from spiked_service.cli.console import messages, output, report_warning
from spiked_service.cli.service_client import Address, Token, TokenFile, client
from spiked_service.results.map_folder import file_name

_POLL_S = 0.25
"""Interval at which the captures are looked at, seconds."""
_OVER = (CaptureState.complete, CaptureState.failed)
INTERRUPTED = 130
"""Exit status after Ctrl-C: 128 + SIGINT, as in shells."""


def record(
    sources: Annotated[list[str], typer.Argument(metavar="DEVICE...", help="usb0, pcie:PATH, sim:, with options.")],
    seconds: Annotated[float | None, typer.Option(help="Length. Default: until Ctrl-C.", min=0.001)] = None,
    frames: Annotated[int | None, typer.Option(help="Length in frames, instead of seconds.", min=1)] = None,
    name: Annotated[str, typer.Option(help="Name of the captures; of several each gets its device's, too.")] = "",
    reconstruct: Annotated[bool, typer.Option("--reconstruct", help="Reconstruct each while it is recorded.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder that the recordings are copied to afterwards.")
    ] = None,
    address: Address = None,
    token: Token = None,
    token_file: TokenFile = None,
) -> None:
    """Record devices of a running service together, and print how their clocks lie to each other.

    Several devices are started together or not at all: if one cannot start, the error names it. Ctrl-C or SIGTERM
    stops all of them. At the end each recording is printed with its frames and losses, and, of all but the first, the
    time from the first frame of the first recording to its own, with its standard deviation. Absent devices are waited
    for. The exit code is 1 if a capture failed or its recording is bad, for instance without a frame.

    Examples:

    - `spiked record usb0 usb1 --seconds 5 -o both`

    - `spiked record 'sim:?seed=1' 'sim:?seed=2' --frames 20000`
    """
    if seconds is not None and frames is not None:
        raise ConfigurationError("--seconds and --frames both set the length; give one of them")
    if out is not None:
        outputs.try_folder("--out", out)
    plans = [
        CaptureRequest(
            source=source,
            seconds=seconds,
            frames=frames,
            reconstruct=reconstruct,
            name=f"{name} {source}" if name and len(sources) > 1 else name,
        )
        for source in sources
    ]
    with client(address, token, token_file) as service:
        # The end of the terminal and SIGTERM stop the captures, as Ctrl-C does: nobody else would.
        with handling(dict.fromkeys(ending_signals(), signal.default_int_handler)):
            run = _Run(service, plans)
            stopped = run.wait()
        _show(run)
        if out is not None:
            _save(service, run.captures, out)
    if status := _status(run.captures, stopped):
        raise typer.Exit(status)


def _status(captures: list[CaptureOut], stopped: bool) -> int:
    """The exit status."""
    if stopped and any(one.state not in _OVER for one in captures):
        return INTERRUPTED
    return int(any(one.state is CaptureState.failed or _grade(one) is Grade.bad for one in captures))


def _grade(capture: CaptureOut) -> Grade | None:
    return None if capture.verdict is None else capture.verdict.grade


class _Run:
    """One capture, or a group of several."""

    def __init__(self, client: Spiked, plans: list[CaptureRequest]) -> None:
        """Start them. Raises ApiError, and then nothing runs."""
        self._client = client
        self._waiting: set[str] = set()
        self.group: GroupOut | None = None
        if len(plans) > 1:
            self.group = client.start_group(plans)
            self.captures = self.group.captures
        else:
            one = plans[0]
            assert one.source is not None
            started = client.start_capture(
                one.source,
                frames=one.frames,
                seconds=one.seconds,
                name=plans[0].name or "",
                reconstruct=bool(one.reconstruct),
            )
            self.captures = [started]

    def look(self) -> None:
        """Ask how they are."""
        if self.group is None:
            self.captures = [self._client.capture(self.captures[0].id)]
        else:
            self.group = self._client.group(self.group.id)
            self.captures = self.group.captures

    def stop(self) -> None:
        """End the acquisition of all."""
        if self.group is None:
            self._client.stop_capture(self.captures[0].id)
        else:
            self._client.stop_group(self.group.id)

    def _say_waiting(self) -> None:
        """Once for each capture: its camera is absent or sends nothing."""
        for one in self.captures:
            if one.state is CaptureState.waiting and one.id not in self._waiting:
                self._waiting.add(one.id)
                report_warning(f"{one.source} waits: {one.reason}")

    def wait(self) -> bool:
        """Until all are over; the first Ctrl-C stops them, a second one leaves. Return whether there was one."""
        stopped = False
        with Live(_table(self.captures), console=messages, transient=True, auto_refresh=False) as live:
            while any(one.state not in _OVER for one in self.captures):
                try:
                    time.sleep(_POLL_S)
                    self.look()
                    self._say_waiting()
                    live.update(_table(self.captures), refresh=messages.is_terminal)
                except KeyboardInterrupt:
                    if stopped:
                        return True
                    stopped = True
                    self.stop()
        return stopped


def _table(captures: list[CaptureOut]) -> Table:
    table = Table(box=None, pad_edge=False)
    for heading in ("device", "state", "frames", "lost"):
        table.add_column(heading)
    for one in captures:
        counters = one.counters
        lost = "-" if counters is None else f"{sum(counters.lost.values()):,}"
        received = "-" if counters is None else f"{counters.received:,}"
        table.add_row(one.source, str(one.state.value), received, lost)
    return table


def _show(run: _Run) -> None:
    """The recordings and offsets, and what was wrong."""
    offsets = (
        {} if run.group is None or run.group.offsets is None else {one.capture_id: one for one in run.group.offsets}
    )
    for one in run.captures:
        recording = one.recording
        grade = _grade(one) if one.state is CaptureState.complete else None
        line = f"{one.source}: capture {one.id}, {(grade or one.state).value}"
        if recording is not None:
            planned = f" of {one.frames_planned:,}" if one.frames_planned else ""
            line += f", {recording.frames:,}{planned} frames, {recording.lost:,} lost"
        reasons = one.reason, *(() if one.verdict is None else one.verdict.reasons)
        line += "".join(f"; {reason}" for reason in reasons if reason)
        output.print(line, markup=False)
        for warning in one.warnings:
            report_warning(f"{one.source}: {warning}")
        offset = offsets.get(one.id)
        if offset is None:
            continue
        if offset.offset_s is None:
            output.print(f"  its offset is not known: {offset.reason}", markup=False)
        else:
            sigma = "" if offset.sigma_s is None else f" +- {offset.sigma_s * 1e6:.1f}"
            output.print(
                f"  begins {offset.offset_s * 1e6:+.1f}{sigma} us after {run.captures[0].source}", markup=False
            )


def _save(client: Spiked, captures: list[CaptureOut], folder: Path) -> None:
    with outputs.writing("--out", folder):
        folder.mkdir(parents=True, exist_ok=True)
        for number, one in enumerate(captures, 1):
            if one.recording is None:
                continue
            path = folder / f"{number}-{file_name(one.source.partition('?')[0])}.dat"
            output.print(f"{client.save_recording(one.id, path)}", markup=False)
