"""A machine that can be cut off: a network namespace with a cable to the service and one to the store."""

import os
import shutil
import subprocess
from pathlib import Path
from types import TracebackType

ELSEWHERE = """
import ctypes, os, sys

if "submitit.core._submit" in sys.orig_argv:
    with open(os.environ["TEST_NAMESPACE"]) as namespace:
        if ctypes.CDLL(None, use_errno=True).setns(namespace.fileno(), 0x40000000):
            raise OSError(ctypes.get_errno(), "setns")
"""
"""Put into `sitecustomize.py`, which every Python imports first: agents, and what they start, are in the namespace."""


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


class Cable:
    """Two ends: one on this machine, one in a namespace. It can be pulled out.

    The address `here` is one of this machine, not of the end, so that it can be reached from here without the cable.
    """

    def __init__(self, name: str, namespace: str, network: str) -> None:
        self.name, self.here, self.there = name, f"{network}.1", f"{network}.2"
        self.plugged_in = False
        _ip("addr", "add", f"{self.here}/32", "dev", "lo")
        _ip("link", "add", name, "type", "veth", "peer", "name", f"{name}b", "netns", namespace)
        _ip("addr", "add", f"{network}.3/24", "dev", name)
        _ip("-n", namespace, "addr", "add", f"{self.there}/24", "dev", f"{name}b")
        _ip("-n", namespace, "link", "set", f"{name}b", "up")
        self.plug_in()

    def plug_in(self) -> None:
        """Connect the machines."""
        _ip("link", "set", self.name, "up")
        self.plugged_in = True

    def pull_out(self) -> None:
        """What is sent from now on is lost, and nobody is told."""
        self.plugged_in = False
        _ip("link", "set", self.name, "down")

    def close(self) -> None:
        """Remove it."""
        _ip("link", "del", self.name)
        _ip("addr", "del", f"{self.here}/32", "dev", "lo")


class Machine:
    """A namespace with a cable to the service and one to the store. A context manager."""

    def __init__(self) -> None:
        pid = os.getpid()
        self.name = f"spiked-{pid}"
        _ip("netns", "add", self.name)
        _ip("-n", self.name, "link", "set", "lo", "up")
        network, number = f"10.{64 + pid // 128 % 64}", pid % 128 * 2
        self.to_service = Cable(f"sps{pid}", self.name, f"{network}.{number}")
        self.to_store = Cable(f"spt{pid}", self.name, f"{network}.{number + 1}")

    @staticmethod
    def possible() -> bool:
        """Whether this process may make one."""
        return os.geteuid() == 0 and shutil.which("ip") is not None

    @property
    def path(self) -> Path:
        """The file of the namespace."""
        return Path("/run/netns", self.name)

    def for_agents(self, folder: Path) -> dict[str, str]:
        """Variables for a service whose agents, by submitit's local executor, are to be on this machine."""
        (folder / "sitecustomize.py").write_text(ELSEWHERE)
        return {"PYTHONPATH": os.fspath(folder), "TEST_NAMESPACE": os.fspath(self.path)}

    def __enter__(self) -> "Machine":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for cable in (self.to_service, self.to_store):
            cable.close()
        _ip("netns", "del", self.name)
