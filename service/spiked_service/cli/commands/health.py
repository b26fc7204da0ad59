"""`spiked health`: asks the service of this machine whether it works."""

import json
import ssl
from pathlib import Path
from typing import Annotated
from urllib.error import HTTPError, URLError
from urllib.request import HTTPSHandler, ProxyHandler, build_opener

import typer

from spiked.errors import ConfigurationError
from spiked_service.cli.console import messages, output
from spiked_service.settings.settings import Settings, load_settings

_TIMEOUT_S = 4.0
"""Longest wait for an answer, seconds: less than the limit of the container's check."""
_ANY = {"0.0.0.0": "127.0.0.1", "::": "::1", "": "127.0.0.1"}
"""Addresses that stand for all of this machine, and one that reaches it."""


def address_of(settings: Settings) -> str:
    """Where a service with these settings can be asked from this machine. Raises ConfigurationError for port 0."""
    if settings.port == 0:
        raise ConfigurationError("the port is 0, a free one at each start: name one with `port` or --address")
    host = _ANY.get(settings.host, settings.host)
    host = f"[{host}]" if ":" in host else host
    return f"{'https' if settings.tls_certificate else 'http'}://{host}:{settings.port}"


def health(
    ready: Annotated[
        bool, typer.Option("--ready", help="Whether captures can be started (`/readyz`), not only whether it works.")
    ] = False,
    address: Annotated[
        str | None, typer.Option(help="Address of the service. Default: that of the settings.", show_default=False)
    ] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file, instead of the default files.")] = None,
) -> None:
    """Ask a running service whether it works; exit with 0 or 1. For containers and scripts.

    Takes address and TLS from the settings, and needs no token. The certificate is not verified: it names the host for
    others, and the question goes to this machine.

    Examples:

    - `spiked health`

    - `spiked health --ready --address https://camera.lab:8650`
    """
    base = address or address_of(load_settings({}, config).settings)
    where = base.rstrip("/") + ("/readyz" if ready else "/healthz")
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    opener = build_opener(ProxyHandler({}), HTTPSHandler(context=context))
    try:
        with opener.open(where, timeout=_TIMEOUT_S) as answer:
            report = json.load(answer)
    except HTTPError as error:
        with error:
            report = _report(error.read())
    except (URLError, OSError, ValueError) as error:
        messages.print(f"{where} does not answer: {getattr(error, 'reason', error)}", markup=False)
        raise typer.Exit(1) from error
    for check in report.get("checks", []):
        finding = f": {check['finding']}" if check["finding"] else ""
        output.print(f"{check['verdict']:8s} {check['name']}{finding}", markup=False)
    if report.get("status") not in ("ok", "warning"):
        raise typer.Exit(1)


def _report(body: bytes) -> dict[str, object]:
    """The report of a failed check; another answer says nothing of the health."""
    try:
        found = json.loads(body)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
