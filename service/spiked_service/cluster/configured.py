"""The cluster that the settings ask for."""

import ipaddress
from pathlib import Path

from spiked.errors import ConfigurationError
from spiked_service.cluster.cluster import Cluster
from spiked_service.cluster.engine import EngineOptions
from spiked_service.cluster.remote_worker import Terms
from spiked_service.settings.settings import JobEngine, Settings


def cluster_of(settings: Settings, data: Path) -> Cluster | None:
    """The executor of the settings for the data folder `data`, None for this machine. Raises ConfigurationError."""
    if settings.executor is JobEngine.LOCAL:
        return None
    if settings.executor_url is None and _is_wildcard(settings.host):
        raise ConfigurationError(
            f"executor {settings.executor}: other machines cannot reach {settings.host}; "
            "say by --set executor_url=http://NAME:PORT where they reach this service"
        )
    folder = data.absolute() / "cluster"
    options = EngineOptions(
        kind=str(settings.executor),
        cpus=settings.executor_cpus,
        gpus=settings.executor_gpus,
        address=settings.executor_address or "",
        folder=str(folder / "submitit"),
        options=dict(value.partition("=")[::2] for value in settings.executor_options),
    )
    store = settings.executor_store or (folder / "jobs").as_uri()
    return Cluster(folder, store, options, Terms(settings.executor_lease_s, cache_bytes=settings.executor_cache_bytes))


def _is_wildcard(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False
