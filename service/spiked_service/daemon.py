"""The running service: its parts put together, its sockets, its signals, and its end."""

import asyncio
import os
import signal
import socket
import ssl
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

import uvicorn

from spiked.errors import ConfigurationError, SpikedError
from spiked_service.api.announce import BusAnnouncer
from spiked_service.api.app import create_app
from spiked_service.api.services import Services
from spiked_service.commands.version import installed_version
from spiked_service.config import Settings
from spiked_service.events import Bus
from spiked_service.health import Health, Pulse, failed
from spiked_service.keeping import Keeping
from spiked_service.live import LiveSettings
from spiked_service.logs import configure_logs, logger, set_level
from spiked_service.runtime import RuntimeFolder
from spiked_service.security import is_loopback
from spiked_service.store.folder import default_folder
from spiked_service.systemd import Notifier
from spiked_service.tokens import Tokens
from spiked_service.zmq import ZmqServer

_log = logger("spiked.daemon")
_CONNECTIONS = 1000
"""More at a time are answered with 503 at once."""
_GONE_MS = 60_000
"""A connection whose other end takes nothing for this long is closed by the kernel."""
_MESSAGE_BYTES = 65_536


class Daemon:
    """Everything but the command line. As a context manager it owns sockets, folders and workers."""

    def __init__(self, settings: LiveSettings) -> None:
        """Raises ConfigurationError for what cannot be served."""
        now = settings.now
        tokens = Tokens(now.data or default_folder(), now.token.get_secret_value() if now.token else None)
        check_access(now, tokens)
        self._notifier = Notifier()
        self._listener = _listen(now.host, now.port)
        with ExitStack() as ends:
            ends.callback(self._listener.close)
            self._folder = RuntimeFolder(now.runtime)
            ends.callback(self._folder.remove)
            bus = Bus()
            configure_logs(now.log_level, now.log_format, bus)
            settings.on_change(lambda changed: set_level(changed.log_level))
            health = Health()
            self.pulse = Pulse()
            health.add("event loop", self.pulse.check, life=True)
            keeping = Keeping(now.data, BusAnnouncer(bus))
            ends.callback(keeping.close)
            health.add("catalogue", keeping.check_catalogue)
            health.add("disk", keeping.check_disk)
            endpoints = None
            if now.zmq:
                port = self.port + 1 if now.zmq_port is None and now.port else now.zmq_port or 0
                zmq = ZmqServer(bus, port)
                ends.callback(zmq.close)
                health.add("zmq", zmq.check, life=True)
                endpoints = zmq.endpoints
            self.services = Services(settings, tokens, keeping, bus, health, zmq=endpoints)
            self._config = self._server_config(now)
            self._ends = ends.pop_all()

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._listener.getsockname()[1])

    @property
    def address(self) -> str:
        """For a browser on this machine."""
        now = self.services.settings.now
        name = f"[{now.host}]" if ":" in now.host else now.host
        return f"{'https' if now.tls_certificate else 'http'}://{name}:{self.port}/"

    def run(self) -> None:
        """Serve until a signal says to end."""
        _Server(self._config, self, self._notifier).run(sockets=[self._listener])

    def reload(self) -> None:
        """Take what has changed in file and environment; an error is told, and all stays as it was."""
        self._notifier.reloading()
        try:
            done = self.services.settings.reload()
            _log.info("settings reloaded", changed=done.changed, waiting=done.waiting)
        except SpikedError as error:
            _log.error("settings not reloaded", reason=str(error))
        self._notifier.ready(f"serving at {self.address}")

    def lives(self) -> bool:
        """Whether the checks of life pass."""
        return not failed(self.services.health.life())

    def __enter__(self) -> "Daemon":
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.close()

    def _server_config(self, now: Settings) -> uvicorn.Config:
        config = uvicorn.Config(
            create_app(self.services),
            log_config=None,
            access_log=False,
            lifespan="on",
            timeout_graceful_shutdown=1,
            limit_concurrency=_CONNECTIONS,
            ws="websockets-sansio",
            ws_max_size=_MESSAGE_BYTES,
            ws_per_message_deflate=False,
            server_header=False,
            proxy_headers=False,
        )
        config.load()
        if now.tls_certificate is not None:
            config.ssl = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            self.services.settings.on_change(lambda settings: _load_certificate(config.ssl, settings))
        return config


class _Server(uvicorn.Server):
    """Leaves with exit code 0 after SIGINT and SIGTERM: both are ways to end a daemon. SIGHUP reloads the settings."""

    def __init__(self, config: uvicorn.Config, daemon: Daemon, notifier: Notifier) -> None:
        super().__init__(config)
        self._daemon = daemon
        self._notifier = notifier

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Tell systemd when requests are answered."""
        await super().startup(sockets)
        if self.started:
            self._beating = asyncio.create_task(self._daemon.pulse.beat())
            self._notifier.ready(f"serving at {self._daemon.address}")
            _log.info("serving", address=self._daemon.address, version=installed_version())
            self._notifier.watch(self._daemon.lives)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """The workers learn of the end at once, not when the last response is sent.

        On a thread: the signal may have come while this one held a lock of the log or of the events.
        """
        threading.Thread(target=self._dismiss, args=(signal.Signals(sig).name,), name="dismissal").start()
        super().handle_exit(sig, frame)

    def _dismiss(self, name: str) -> None:
        self._notifier.stopping()
        _log.info("stopping", signal=name)
        self._daemon.services.captures.dismiss()

    def handle_reload(self, sig: int, frame: FrameType | None) -> None:
        """On a thread: files are read."""
        threading.Thread(target=self._daemon.reload, name="reload").start()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """As uvicorn does, but without dying of the signal afterwards, which would leave the runtime folder behind."""
        handlers = {
            signal.SIGINT: self.handle_exit,
            signal.SIGTERM: self.handle_exit,
            signal.SIGHUP: self.handle_reload,
        }
        before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def check_access(settings: Settings, tokens: Tokens) -> None:
    """Raises ConfigurationError for an address that others can reach without a token."""
    if (settings.require_token or not is_loopback(settings.host)) and not tokens.some():
        raise ConfigurationError(
            f"--host {settings.host} needs a token that requests must bring: make one with `spiked token create NAME`"
        )


def _listen(host: str, port: int) -> socket.socket:
    """A listening socket, so that the address is known before anything is started. Raises ConfigurationError."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        why = str(error) if error.errno is None or error.errno < 0 else os.strerror(error.errno)
        raise ConfigurationError(f"cannot listen at {host}:{port}: {why}; choose another --host or --port") from error
    # A response is written as head and body: without this the body waits 40 ms for the head's acknowledgement. asyncio
    # would say so too, but only of sockets that name TCP as their protocol.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _GONE_MS)  # its connections inherit it
    return listener


def _load_certificate(context: ssl.SSLContext | None, settings: Settings) -> None:
    """Used by connections made from now on."""
    assert context is not None and settings.tls_certificate is not None
    try:
        context.load_cert_chain(settings.tls_certificate, settings.tls_key)
    except OSError as error:  # ssl.SSLError is one
        raise ConfigurationError(
            f"cannot use {settings.tls_certificate} with {settings.tls_key}: {error}; both are PEM files that belong "
            "together"
        ) from error
