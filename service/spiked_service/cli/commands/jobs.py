"""`spiked jobs`: the queue of a running service: which machine, how far."""

import json
from itertools import islice
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from spiked.client import JobState, ReconstructionOut, Spiked
from spiked_service.cli.console import messages, output
from spiked_service.cli.service_client import Address, TokenFile, client

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
    token_file: TokenFile = None,
) -> None:
    """List the jobs of a running service, newest first: state, machine, progress, time left, and why one failed."""
    if context.invoked_subcommand is not None:
        return
    with client(address, token_file) as service:
        found = list(islice(service.reconstructions(state=state), limit))
        if as_json:
            for job in found:
                print(json.dumps(job.model_dump(mode="json")))
            return
        if found:
            output.print(_table(service, found), soft_wrap=False)
        else:
            messages.print("there are no such jobs", markup=False)


@jobs.command()
def cancel(
    ids: Annotated[list[str], typer.Argument(help="Ids of jobs.")],
    address: Address = None,
    token_file: TokenFile = None,
) -> None:
    """End jobs that wait or run; what they have published stays."""
    with client(address, token_file) as service:
        for one in ids:
            service.cancel_reconstruction(one)


def _table(service: Spiked, found: list[ReconstructionOut]) -> Table:
    names: dict[str, str] = {}
    table = Table(box=None, pad_edge=False)
    for title in ("job", "recording", "state", "machine", "done", "left", ""):
        table.add_column(title, overflow="fold", no_wrap=title != "")
    for job in found:
        if job.capture_id not in names:
            names[job.capture_id] = service.capture(job.capture_id).name
        left = "" if job.eta_s is None or job.state not in ("queued", "running") else f"{job.eta_s:.0f} s"
        waits = "held" if job.held else "" if job.queue_place is None else f"place {job.queue_place}"
        state = job.stage if job.state == "running" else job.state
        done = f"{100 * job.progress:.0f} %"
        why = waits if job.state == "running" else job.reason or waits  # one that runs tells more on the page
        row = (job.id, names[job.capture_id], str(state.value), job.node, done, left, why)
        table.add_row(*(Text(part) for part in row))
    return table
