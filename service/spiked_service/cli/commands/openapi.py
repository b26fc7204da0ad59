"""`spiked openapi`: the OpenAPI description, for client generators."""

import json
from pathlib import Path
from typing import Annotated

import typer

from spiked_service.cli import outputs
from spiked_service.cli.console import output
from spiked_service.daemon import api_document


def openapi(
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write. Default: standard output.")] = None,
) -> None:
    """Print the OpenAPI description of the service as JSON.

    Example: `spiked openapi -o openapi.json`
    """
    if out is not None:
        outputs.try_file("--out", out)
    text = json.dumps(api_document(), indent=1)
    if out is None:
        output.file.write(text + "\n")
    else:
        with outputs.writing("--out", out):
            out.write_text(text + "\n", encoding="utf-8")
