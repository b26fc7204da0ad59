"""`spiked submit`: sends recordings to a running service and queues a reconstruction of each."""

from typing import Annotated

import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn

from spiked.client import ReconstructionOptions, ReconstructionOut, Spiked
from spiked.errors import SpikedError
from spiked_service.cli.console import messages, output, report_error
from spiked_service.cli.recording_uris import Found, find
from spiked_service.cli.service_client import Address, Token, TokenFile, client


def submit(
    recordings: Annotated[
        list[str],
        typer.Argument(help="Files, patterns such as `runs/**/*.dat`, or URIs such as `s3://bucket/**/*.dat`."),
    ],
    steps: Annotated[int | None, typer.Option(help="Gradient steps of the refinement.", min=0)] = None,
    seconds: Annotated[float | None, typer.Option(help="Time budget in seconds of work.", min=0.001)] = None,
    threads: Annotated[int | None, typer.Option(help="Threads of the rasteriser.", min=1)] = None,
    priority: Annotated[int, typer.Option(help="Higher ones run first.", min=-1000, max=1000)] = 0,
    address: Address = None,
    token: Token = None,
    token_file: TokenFile = None,
) -> None:
    """Send recordings to a running service, and queue a reconstruction of each. Prints the ids of the jobs.

    The sidecar beside a recording goes with it. A file of a store is read by ranges, without a copy on this machine.
    One that cannot be sent is reported, the others go on, and the exit status is 1.

    Examples:

    - `spiked submit run1.dat run2.dat`

    - `spiked submit 's3://bucket/2026/**/*.dat' --steps 1000 --address http://gpu.lab:8650`
    """
    given = {"steps": steps, "seconds": seconds, "threads": threads}
    options = ReconstructionOptions.model_validate({name: value for name, value in given.items() if value is not None})
    found = find(recordings)
    failed = 0
    with client(address, token, token_file) as service:
        for one in found:
            try:
                job = _submit(service, one, options, priority)
            except (SpikedError, OSError, ValueError) as error:
                report_error(SpikedError(f"{one.uri}: {error}"))
                failed += 1
                continue
            output.print(f"{job.id}  {one.uri}", markup=False)
    if failed:
        messages.print(f"{failed} of {len(found)} recordings were not queued", markup=False)
        raise typer.Exit(1)


def _submit(service: Spiked, one: Found, options: ReconstructionOptions, priority: int) -> ReconstructionOut:
    columns = TextColumn("{task.description}"), BarColumn(), DownloadColumn()
    with Progress(*columns, console=messages, transient=True) as progress, one.open() as file:
        bar = progress.add_task(one.name, total=one.size)
        capture = service.upload_from(
            file,
            one.name,
            one.size,
            sidecar=one.sidecar(),
            notes=one.uri,
            progress=lambda done, _: progress.update(bar, completed=done),
        )
    return service.start_reconstruction(capture.id, options=options, priority=priority)
