"""Ray nodes of `measure_cluster.py` on this machine, which can be killed and cut off."""

import os
import random
import subprocess
import sys
import threading
from collections import Counter
from contextlib import suppress
from pathlib import Path

import psutil
from namespace_machine import Cable, Machine
from ports import free_port

MARK = "SPIKED_MEASURED_NODES"
"""Variable of the environment of the processes of Ray that this run has started: others run Ray here, too."""
RAY = str(Path(sys.executable).with_name("ray"))


class RayNodes:
    """A head without cores, and two nodes with one core each, all on this machine.

    The second node is on the `machine`, if there is one, where it reaches the head by the cable to the service.
    """

    def __init__(self, machine: Machine | None) -> None:
        self._machine = machine
        here = "127.0.0.1" if machine is None else machine.to_service.here
        self.address = f"{here}:{free_port()}"
        """Of the head."""
        port = self.address.rpartition(":")[2]
        at = [] if machine is None else [f"--node-ip-address={here}"]
        self._run("--head", f"--port={port}", *at, "--num-cpus=0", "--include-dashboard=false")
        self._nodes: list[list[psutil.Process]] = [[], []]
        self.mend()

    def kill(self, random_: random.Random) -> None:
        """Kill a node with all that runs on it."""
        self._kill(random_.randrange(2))

    def mend(self) -> None:
        """Start the nodes that do not run, also those that Ray has ended after they were cut off."""
        for number, node in enumerate(self._nodes):
            if node and all(_runs(one) for one in node):
                continue
            self._kill(number)
            machine = self._machine if number == 1 else None
            if machine is None or machine.to_service.plugged_in:
                self._nodes[number] = self._node(machine)

    def close(self) -> None:
        """End all nodes of this run, with what runs on them."""
        while found := self._processes():
            for process in found:
                with suppress(psutil.Error):
                    process.kill()
            psutil.wait_procs(found, timeout=10)

    def _kill(self, number: int) -> None:
        for node in self._nodes[number]:
            with suppress(psutil.Error):
                for process in [*node.children(recursive=True), node]:
                    with suppress(psutil.Error):
                        process.kill()
        self._nodes[number] = []

    def _node(self, machine: Machine | None) -> list[psutil.Process]:
        """Start a node. Return its raylet, and its log monitor, which would outlive it and slow down the others."""
        before = {one.pid for one in self._processes()}
        at = [] if machine is None else [f"--node-ip-address={machine.to_service.there}"]
        self._run(f"--address={self.address}", *at, "--num-cpus=1", machine=machine)
        return [one for one in self._processes() if one.pid not in before and _is_of_a_node(one)]

    def _processes(self) -> list[psutil.Process]:
        """All that this run has started of Ray, and what that has started: some overwrite their environment."""
        found: dict[int, psutil.Process] = {}
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                if process.environ().get(MARK) == self.address and process.status() != psutil.STATUS_ZOMBIE:
                    found |= {one.pid: one for one in [process, *process.children(recursive=True)]}
        return list(found.values())

    def _run(self, *words: str, machine: Machine | None = None) -> None:
        environment = os.environ | {MARK: self.address}
        there = [] if machine is None else ["nsenter", f"--net={machine.path}"]
        command = [*there, RAY, "start", "--disable-usage-stats", *words]
        subprocess.run(command, check=True, capture_output=True, env=environment)


class Partitions:
    """Cuts a machine off, for times that are shorter or longer than a lease. Ends with its machine plugged in."""

    def __init__(self, machine: Machine, lease_s: float) -> None:
        self._machine = machine
        self._lease_s = lease_s
        self._timer: threading.Timer | None = None
        self.happened: Counter[str] = Counter()
        """How often it was cut off from what, for how long."""

    def cut(self, random_: random.Random) -> bool:
        """Pull out a cable or both, until later. Return whether all were plugged in."""
        both = (self._machine.to_service, self._machine.to_store)
        if not all(one.plugged_in for one in both):
            return False
        what, cables = random_.choice((("service", both[:1]), ("store", both[1:]), ("both", both)))
        length, share = random_.choice((("short", random_.uniform(0.2, 0.7)), ("long", random_.uniform(1.5, 4.0))))
        self.happened[f"{what}, {length}"] += 1
        for one in cables:
            one.pull_out()
        self._timer = threading.Timer(share * self._lease_s, _plug_in, (cables,))
        self._timer.start()
        return True

    def close(self) -> None:
        """Wait until all is plugged in."""
        if self._timer is not None:
            self._timer.join()


def _plug_in(cables: tuple[Cable, ...]) -> None:
    for one in cables:
        one.plug_in()


def _runs(process: psutil.Process) -> bool:
    with suppress(psutil.Error):
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    return False


def _is_of_a_node(process: psutil.Process) -> bool:
    with suppress(psutil.Error):
        return process.name() == "raylet" or any(part.endswith("log_monitor.py") for part in process.cmdline())
    return False
