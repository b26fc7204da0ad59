"""`spiked jobs`: the queue of a running service: which machine, how far."""

import json
from itertools import islice
from typing import Annotated

import typer

from spiked.client import JobState, ReconstructionOut, Spiked
from spiked_service.cli.console import messages, output
from spiked_service.cli.service_client import Address, Token, TokenFile, client

_TITLES = ("job", "state", "machine", "done", "left", "recording", "")
"""Of the columns; the last one, why or where a job waits, is as long as it is."""

jobs = typer.Typer(
    help="List the jobs of a running service, newest first: state, machine, progress, time left; and cancel them.\n\n"
    "Examples:\n\n- `spiked jobs --state running`\n\n"
    "- `spiked jobs --json --limit 1000 | jq -r 'select(.state == \"failed\") | .reason'`\n\n"
    "- `spiked jobs cancel 01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10`",
    invoke_without_command=True,
)


@jobs.callback()
def listing(
    context: typer.Context,
    state: Annotated[JobState | None, typer.Option(help="Only those in this state.", show_default=False)] = None,
    limit: Annotated[int, typer.Option(help="Most jobs, the newest.", min=1, max=100_000)] = 50,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, a job a line.")] = False,
    address: Address = None,
    token: Token = None,
    token_file: TokenFile = None,
) -> None:
    """List the jobs of a running service, newest first: state, machine, progress, time left, and why one failed."""
    if context.invoked_subcommand is not None:
        return
    with client(address, token, token_file) as service:
        found = list(islice(service.reconstructions(state=state), limit))
        if as_json:
            for job in found:
                print(json.dumps(job.model_dump(mode="json")))
            return
        for line in _lines(service, found) if found else ():
            output.print(line, markup=False)
        if not found:
            messages.print("there are no such jobs", markup=False)


@jobs.command()
def cancel(
    ids: Annotated[list[str], typer.Argument(help="Ids of jobs.")],
    address: Address = None,
    token: Token = None,
    token_file: TokenFile = None,
) -> None:
    """End jobs that wait or run; what they have published stays."""
    with client(address, token, token_file) as service:
        for one in ids:
            service.cancel_reconstruction(one)


def _lines(service: Spiked, found: list[ReconstructionOut]) -> list[str]:
    """A line a job in aligned columns, after one with the titles."""
    names: dict[str, str] = {}
    rows = [_TITLES]
    for job in found:
        if job.capture_id not in names:
            names[job.capture_id] = service.capture(job.capture_id).name
        over = job.state not in ("queued", "running")
        left = "" if job.eta_s is None or over else f"{job.eta_s:.0f} s"
        waits = "held" if job.held else "" if job.queue_place is None else f"place {job.queue_place}"
        state = job.stage if job.state == "running" else job.state
        why = waits if job.state == "running" else job.reason or waits  # one that runs tells more on the page
        rows.append((job.id, state.value, job.node, f"{100 * job.progress:.0f} %", left, names[job.capture_id], why))
    widths = [max(len(row[column]) for row in rows) for column in range(len(_TITLES))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
