"""The listening socket and the configuration of the HTTP server, with TLS."""

import os
import socket
import ssl

import uvicorn
from starlette.types import ASGIApp

from spiked.errors import ConfigurationError
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.settings import Settings

CONNECTIONS = 1000
"""Further concurrent connections are answered with 503."""
_USER_TIMEOUT_MS = 60_000
"""The kernel closes connections whose peer acknowledges nothing for this long."""
KEPT_ALIVE_S = 120
"""An idle connection is closed after this long.

Longer than clients and proxies use one again after (httpx 5 s, aiohttp 15 s, nginx and AWS's load balancers 60 s, Go
90 s): a request that crosses the closing of its connection is lost without an answer.
"""
MESSAGE_BYTES = 65_536
"""Largest WebSocket message from a client."""


def listen(host: str, port: int) -> socket.socket:
    """Open the listening socket before anything else starts. Raises ConfigurationError."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        why = str(error) if error.errno is None or error.errno < 0 else os.strerror(error.errno)
        raise ConfigurationError(f"cannot listen at {host}:{port}: {why}; choose another --host or --port") from error
    # Head and body are written separately: without TCP_NODELAY the body waits 40 ms for an acknowledgement. asyncio
    # sets it only for sockets whose protocol is given as TCP.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _USER_TIMEOUT_MS)  # inherited by its connections
    return listener


def server_config(app: ASGIApp, settings: ReloadableSettings) -> uvicorn.Config:
    """The configuration of the server; its certificate is loaded again when the settings change.

    Raises ConfigurationError.
    """
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        lifespan="on",
        timeout_graceful_shutdown=1,
        timeout_keep_alive=KEPT_ALIVE_S,
        limit_concurrency=CONNECTIONS,
        ws="websockets-sansio",
        ws_max_size=MESSAGE_BYTES,
        ws_per_message_deflate=False,
        server_header=False,
        proxy_headers=False,
    )
    config.load()
    if settings.now.tls_certificate is not None:
        config.ssl = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        settings.on_change(lambda now: _load_certificate(config.ssl, now))
    return config


def _load_certificate(context: ssl.SSLContext | None, settings: Settings) -> None:
    """Load the certificate for new connections."""
    assert context is not None and settings.tls_certificate is not None
    try:
        context.load_cert_chain(settings.tls_certificate, settings.tls_key)
    except OSError as error:  # ssl.SSLError is one
        raise ConfigurationError(
            f"cannot use {settings.tls_certificate} with {settings.tls_key}: {error}; both are PEM files that belong "
            "together"
        ) from error
