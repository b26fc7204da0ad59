"""The parts of a running service that the application uses."""

from dataclasses import dataclass

from spiked_service.api.idempotency import IdempotencyKeys
from spiked_service.api.results import Results
from spiked_service.api.routes.devices import DeviceWatch
from spiked_service.api.sources import Sources
from spiked_service.api.zmq import Endpoints
from spiked_service.base.health import Health
from spiked_service.base.limits import ConcurrencyLimit
from spiked_service.captures.captures import Captures
from spiked_service.captures.uploads import Uploads
from spiked_service.cluster.cluster import Cluster
from spiked_service.events.bus import Bus
from spiked_service.operations.metrics import Metrics
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.results.view_renderer import ViewRenderer
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.tokens import Tokens
from spiked_service.store.folder import DataFolder


@dataclass(frozen=True)
class Services:
    """Built once by `spiked_service.daemon`."""

    settings: ReloadableSettings
    tokens: Tokens
    bus: Bus
    health: Health
    metrics: Metrics
    folder: DataFolder
    captures: Captures
    reconstructions: Reconstructions
    uploads: Uploads
    results: Results
    views: ViewRenderer
    sources: Sources
    device_watch: DeviceWatch
    idempotency_keys: IdempotencyKeys
    event_clients: ConcurrencyLimit
    """Limits concurrent clients of the events."""
    zmq: Endpoints | None
    """None if ZeroMQ is turned off."""
    cluster: Cluster | None = None
    """Runs jobs on other machines; None if they run here."""
