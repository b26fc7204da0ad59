"""What the routes work with: the parts of one running service."""

from dataclasses import dataclass, field

from spiked_service.captures import Captures
from spiked_service.events import Bus
from spiked_service.health import Health
from spiked_service.keeping import Keeping
from spiked_service.limits import Gate
from spiked_service.live import LiveSettings
from spiked_service.metrics import Metrics
from spiked_service.readings import readings_of
from spiked_service.reconstructions import Reconstructions
from spiked_service.tokens import Tokens
from spiked_service.zmq import Endpoints


@dataclass(frozen=True)
class Services:
    """Made once, by whoever runs the service."""

    settings: LiveSettings
    tokens: Tokens
    keeping: Keeping
    bus: Bus
    health: Health = field(default_factory=Health)
    renders: Gate = field(default_factory=lambda: Gate("renders", 1))
    """Every rendering of a view goes through it."""
    event_clients: Gate = field(default_factory=lambda: Gate("event clients", 1))
    zmq: Endpoints | None = None
    metrics: Metrics = field(init=False)

    @property
    def captures(self) -> Captures:
        """All captures."""
        return self.keeping.captures

    @property
    def reconstructions(self) -> Reconstructions:
        """All reconstructions."""
        return self.keeping.reconstructions

    def __post_init__(self) -> None:
        """The limits follow the settings."""
        readings = readings_of(self.keeping)
        metrics = Metrics(readings, self.bus, self.health, self.renders, self.event_clients)
        object.__setattr__(self, "metrics", metrics)
        self.settings.on_change(lambda now: setattr(self.renders, "limit", now.limit_renders))
        self.settings.on_change(self.keeping.configure)
        self.settings.on_change(lambda now: setattr(self.event_clients, "limit", now.limit_event_clients))
