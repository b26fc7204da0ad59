"""`spiked openapi`: the description of the API, for generators of clients."""

import json
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from spiked_service.api.announce import BusAnnouncer
from spiked_service.api.app import create_app
from spiked_service.api.services import Services
from spiked_service.console import output
from spiked_service.events import Bus
from spiked_service.keeping import Keeping
from spiked_service.live import LiveSettings
from spiked_service.tokens import Tokens


def openapi(
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write; standard output if not given.")
    ] = None,
) -> None:
    """Print the OpenAPI description of the service as JSON.

    Example: `spiked openapi -o openapi.json`
    """
    with tempfile.TemporaryDirectory(prefix="spiked-") as folder, ExitStack() as ends:
        bus = Bus()
        keeping = Keeping(Path(folder), BusAnnouncer(bus))
        ends.callback(keeping.close)
        services = Services(LiveSettings(), Tokens(Path(folder), None), keeping, bus)
        text = json.dumps(create_app(services).openapi(), indent=1)
    if out is None:
        output.file.write(text + "\n")
    else:
        out.write_text(text + "\n", encoding="utf-8")
