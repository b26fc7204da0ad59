"""`daemon.py` alone puts the parts of the service together."""

import ast
import inspect
from pathlib import Path
from typing import get_type_hints

import spiked_service
from spiked_service.api.services import Services
from spiked_service.api.zmq import ZmqServer
from spiked_service.base.limits import ConcurrencyLimit
from spiked_service.captures.archive import DataStore
from spiked_service.reconstructions.queue_policy import QueuePolicy
from spiked_service.reconstructions.repository import ReconstructionRepository

SERVICE = Path(spiked_service.__file__).parent
ELSEWHERE = {
    ("Catalogue", "captures/reconcile.py"),  # opens it, or a new one in place of a damaged one
    ("Catalogue", "store/backup.py"),
    ("DataFolder", "cli/commands/restore.py"),  # of a service that need not run
    ("ReloadableSettings", "cli/commands/serve.py"),  # read from the flags of the command
    ("Tokens", "cli/commands/token.py"),
}


def parts() -> set[str]:
    """Names of the classes that the application and the data store are given, and of a few below them."""
    given = [*get_type_hints(Services).values(), *get_type_hints(DataStore.__init__).values()]
    below = [Services, DataStore, ZmqServer, ConcurrencyLimit, QueuePolicy, ReconstructionRepository]
    return {
        one.__name__
        for one in (*given, *below)
        if inspect.isclass(one) and one.__module__.startswith("spiked_service.") and "Protocol" not in str(one.__mro__)
    }


def constructions(path: Path) -> set[str]:
    """Names that a module calls."""
    calls = (node.func for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call))
    return {call.id if isinstance(call, ast.Name) else getattr(call, "attr", "") for call in calls}


def test_only_the_daemon_constructs_the_parts() -> None:
    found = {
        (name, str(path.relative_to(SERVICE)))
        for path in SERVICE.rglob("*.py")
        for name in constructions(path) & parts()
    }
    daemon = {name for name, file in found if file == "daemon.py"}
    assert parts() - daemon <= {"Catalogue"}, "the daemon does not construct them"
    assert {one for one in found if one[1] != "daemon.py"} == ELSEWHERE
