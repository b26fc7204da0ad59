"""The service process: puts the parts together, handles signals and shuts down.

No other module constructs the parts, except for tools that need one of them without a service.
"""

import asyncio
import signal
import socket
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn

from spiked.errors import ConfigurationError, SpikedError
from spiked.ring import clean_stale
from spiked_service.api.app import create_app
from spiked_service.api.auth.security import is_loopback
from spiked_service.api.bus_notifier import BusNotifier
from spiked_service.api.idempotency import IdempotencyKeys
from spiked_service.api.listener import listen, server_config
from spiked_service.api.results import Results
from spiked_service.api.routes.devices import DeviceWatch
from spiked_service.api.services import Services
from spiked_service.api.sources import Sources
from spiked_service.api.zmq import Endpoints, ZmqServer
from spiked_service.base.health import EventLoopHeartbeat, Health, failed
from spiked_service.base.limits import ConcurrencyLimit
from spiked_service.base.signals import handling
from spiked_service.base.version import installed_version
from spiked_service.captures.archive import DataStore
from spiked_service.captures.captures import Captures
from spiked_service.captures.purging import resume_purges
from spiked_service.captures.reconcile import open_catalogue, reconcile
from spiked_service.captures.recovery import Recovery
from spiked_service.captures.uploads import Uploads
from spiked_service.cluster.cluster import Cluster
from spiked_service.cluster.configured import cluster_of
from spiked_service.events.bus import Bus
from spiked_service.events.logging import configure_logs, logger, set_level
from spiked_service.operations.metrics import Metrics
from spiked_service.operations.metrics_sources import metrics_source_of
from spiked_service.operations.runtime_folder import RuntimeFolder
from spiked_service.operations.systemd import SystemdNotifier
from spiked_service.operations.webhooks import Webhooks
from spiked_service.reconstructions.executor import Executor
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.reconstructions.queue_policy import REMOTE_DELAYS_S, QueuePolicy
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.results.view_renderer import ViewRenderer
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.settings import Settings
from spiked_service.settings.tokens import Tokens, token_of
from spiked_service.store.disk_space import DiskSpace
from spiked_service.store.folder import DataFolder, default_folder
from spiked_service.store.retention import Retention

_log = logger("spiked.daemon")


class Daemon:
    """The service without its command line. A context manager that owns sockets, folders and workers."""

    def __init__(self, settings: ReloadableSettings) -> None:
        """Raises ConfigurationError for settings that cannot be used."""
        now = settings.now
        tokens = Tokens(now.data or default_folder(), token_of(now))
        check_access(now, tokens)
        self._systemd = SystemdNotifier()
        self._listener = listen(now.host, now.port)
        with ExitStack() as ends:
            ends.callback(self._listener.close)
            self._folder = RuntimeFolder(now.runtime)
            ends.callback(self._folder.remove)
            bus = Bus()
            configure_logs(now.log_level, now.log_format, bus)
            settings.on_change(lambda changed: set_level(changed.log_level))
            health = Health()
            self.heartbeat = EventLoopHeartbeat()
            health.add("event loop", self.heartbeat.check, life=True)
            cluster = cluster_of(now, now.data or default_folder())
            if cluster is not None:
                cluster.url = now.executor_url or _address(now, self.port)
                ends.callback(cluster.close)
            data_store = open_data_store(now.data, BusNotifier(bus), cluster)
            ends.callback(data_store.close)
            health.add("catalogue", data_store.check_catalogue)
            health.add("disk", data_store.check_disk)
            endpoints = None
            if now.zmq:
                port = self.port + 1 if now.zmq_port is None and now.port else now.zmq_port or 0
                zmq = ZmqServer(bus, port)
                ends.callback(zmq.close)
                health.add("zmq", zmq.check, life=True)
                endpoints = zmq.endpoints
            self.services = build_services(settings, tokens, data_store, bus, health, endpoints, cluster)
            ends.callback(Webhooks(bus, lambda: settings.now.webhooks).close)
            self._config = server_config(create_app(self.services), settings)
            self._ends = ends.pop_all()

    @property
    def port(self) -> int:
        """TCP port that it listens on."""
        return int(self._listener.getsockname()[1])

    @property
    def address(self) -> str:
        """URL for a browser on this machine."""
        return _address(self.services.settings.now, self.port)

    def run(self) -> None:
        """Serve until SIGINT or SIGTERM."""
        _Server(self._config, self, self._systemd).run(sockets=[self._listener])

    def reload(self) -> None:
        """Reload the settings. Errors are logged and change nothing."""
        self._systemd.reloading()
        try:
            done = self.services.settings.reload()
            _log.info("settings reloaded", changed=done.changed, waiting=done.waiting)
        except SpikedError as error:
            _log.error("settings not reloaded", reason=str(error))
        self._systemd.ready(f"serving at {self.address}")

    def lives(self) -> bool:
        """Whether the liveness checks pass."""
        return not failed(self.services.health.life())

    def __enter__(self) -> "Daemon":
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.close()


def _address(settings: Settings, port: int) -> str:
    name = f"[{settings.host}]" if ":" in settings.host else settings.host
    return f"{'https' if settings.tls_certificate else 'http'}://{name}:{port}/"


def open_data_store(data: Path | None, notifier: Notifier, executor: Executor | None = None) -> DataStore:
    """Open and reconcile the data folder, and start its maintenance; `executor` runs jobs, if not this machine.

    Raises ConfigurationError or StoreError.
    """
    folder = DataFolder(data)
    try:
        folder.sweep()
        clean_stale()
        catalogue = open_catalogue(folder, notifier.log)
        resume_purges(folder, catalogue)
        orphans = reconcile(folder, catalogue, notifier.log)
    except BaseException:
        folder.close()
        raise
    disk_space = DiskSpace(folder, catalogue)
    policy = QueuePolicy() if executor is None else QueuePolicy(delays_s=REMOTE_DELAYS_S)
    rows = ReconstructionRepository(folder, catalogue, notifier, policy)
    reconstructions = Reconstructions(folder, catalogue, notifier, policy, rows, executor)
    captures = Captures(folder, catalogue, disk_space, reconstructions, notifier)
    retention = Retention(folder, catalogue, captures.removal, lambda text: notifier.log("info", text))
    recovery = Recovery(folder, catalogue, rows, notifier, orphans)
    return DataStore(folder, catalogue, disk_space, reconstructions, captures, retention, recovery, notifier)


def build_services(
    settings: ReloadableSettings,
    tokens: Tokens,
    data_store: DataStore,
    bus: Bus,
    health: Health,
    zmq: Endpoints | None = None,
    cluster: Cluster | None = None,
) -> Services:
    """The parts that the application uses, with the limits of the settings, now and after each reload."""
    captures, reconstructions, folder = data_store.captures, data_store.reconstructions, data_store.folder
    renders = ConcurrencyLimit("renders", 1)
    trajectories = ConcurrencyLimit("trajectories or bundles", 1)
    event_clients = ConcurrencyLimit("event clients", 1)
    limits = {"renders": renders, "trajectories": trajectories, "event_clients": event_clients}
    settings.on_change(lambda now: setattr(renders, "limit", now.limit_renders))
    settings.on_change(lambda now: setattr(trajectories, "limit", now.limit_trajectories))
    settings.on_change(lambda now: setattr(event_clients, "limit", now.limit_event_clients))
    settings.on_change(data_store.configure)
    sources = Sources(settings)
    return Services(
        settings=settings,
        tokens=tokens,
        bus=bus,
        health=health,
        metrics=Metrics(
            metrics_source_of(captures, reconstructions, data_store.catalogue, folder.path), bus, health, limits
        ),
        folder=folder,
        captures=captures,
        reconstructions=reconstructions,
        uploads=Uploads(folder, data_store.catalogue, data_store.disk_space, lambda: settings.now.limit_upload_bytes),
        results=Results(reconstructions.rows, captures, trajectories),
        views=ViewRenderer(renders),
        sources=sources,
        device_watch=DeviceWatch(captures, sources, bus),
        idempotency_keys=IdempotencyKeys(data_store.catalogue),
        event_clients=event_clients,
        zmq=zmq,
        cluster=cluster,
    )


def api_document() -> dict[str, Any]:
    """The OpenAPI document of a service with default settings and an empty data folder."""
    with tempfile.TemporaryDirectory(prefix="spiked-") as name, ExitStack() as ends:
        bus, folder = Bus(), Path(name)
        data_store = open_data_store(folder, BusNotifier(bus))
        ends.callback(data_store.close)
        services = build_services(ReloadableSettings(), Tokens(folder, None), data_store, bus, Health())
        return create_app(services).openapi()


class _Server(uvicorn.Server):
    """Exits with code 0 after SIGINT and SIGTERM. SIGHUP reloads the settings."""

    def __init__(self, config: uvicorn.Config, daemon: Daemon, systemd: SystemdNotifier) -> None:
        super().__init__(config)
        self._daemon = daemon
        self._systemd = systemd

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Notify systemd once requests are answered."""
        await super().startup(sockets)
        if self.started:
            self._beating = asyncio.create_task(self._daemon.heartbeat.beat())
            self._systemd.ready(f"serving at {self._daemon.address}")
            _log.info("serving", address=self._daemon.address, version=installed_version())
            self._systemd.watch(self._daemon.lives)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Dismiss the workers at once rather than after the last response.

        On a thread, because the signal may have interrupted code that holds a lock of the log or the bus.
        """
        threading.Thread(target=self._dismiss, args=(signal.Signals(sig).name,), name="dismissal").start()
        super().handle_exit(sig, frame)

    def _dismiss(self, name: str) -> None:
        self._systemd.stopping()
        _log.info("stopping", signal=name)
        self._daemon.services.captures.dismiss()

    def handle_reload(self, sig: int, frame: FrameType | None) -> None:
        """Reload on a thread, because files are read."""
        threading.Thread(target=self._daemon.reload, name="reload").start()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """As in uvicorn, but without raising the signal again afterwards, which would skip the cleanup."""
        handlers = {
            signal.SIGINT: self.handle_exit,
            signal.SIGTERM: self.handle_exit,
            signal.SIGHUP: self.handle_reload,
        }
        with handling(handlers):
            yield


def check_access(settings: Settings, tokens: Tokens) -> None:
    """Raises ConfigurationError if other hosts could connect without a token."""
    if (settings.require_token or not is_loopback(settings.host)) and not tokens.some():
        raise ConfigurationError(
            f"--host {settings.host} needs a token that requests must bring: make one with `spiked token create NAME`"
        )
