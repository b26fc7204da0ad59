"""What tests hold: cameras in a process of their own, and the environment in which libusb finds them."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from .faults import Fault
from .host import CameraSettings
from .stream import Run
from .testbed import PRELOAD

_HERE = Path(__file__).resolve().parent


def missing() -> str | None:
    """Why there can be no rig here, None if there can."""
    if shutil.which("umockdev-run") is None:
        return "the Debian package umockdev is not installed (apt-get install umockdev)"
    return None


@dataclass(frozen=True)
class Report:
    """What a camera did."""

    sent: tuple[Run, ...]
    """Frames that went towards the host, by the camera's own numbers."""
    next_frame: int
    start_s: float
    """Monotonic: with a rate, frame k is there 1 + k frames later."""
    handed_over: tuple[tuple[int, float], ...]
    """For the last full transfers: the frame in which each ends, and the monotonic time at which the host had
    it: after the frame was there by what the camera's process and its usbfs take."""
    dropped: int
    """Frames that the host did not take in time."""
    done: tuple[str, ...]
    """The kinds of faults that happened."""
    requests: tuple[tuple[int, int], ...]
    """Index and length of the last read requests."""
    bad_requests: int
    commands: tuple[int, ...]
    """Session commands but for reads: 0 abort, 2 stream, 3 flush."""
    in_flight_bytes: int
    room_bytes: int
    """Bytes that the camera can send into the reads that are queued."""
    plugged: bool
    port: str
    direct_memory: bool | None

    @property
    def sent_frames(self) -> int:
        """How many went towards the host."""
        return sum(run.count for run in self.sent)

    def runs(self, number: int) -> bool:
        """Whether the frame went towards the host."""
        return any(run.first <= number < run.first + run.count for run in self.sent)


class VirtualCameras:
    """Cameras at a mocked machine, from creation to `close`."""

    def __init__(
        self,
        cameras: Sequence[CameraSettings],
        *,
        usbfs_memory_mb: int = 16,
        direct_memory: bool = True,
        own_processes: bool = False,
    ) -> None:
        """`own_processes`: each camera but the first is served by a process of its own."""
        environment = {**os.environ, "PYTHONPATH": str(_HERE.parent)}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "virtual_camera.host"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        answer = self._ask(
            cameras=[asdict(camera) for camera in cameras],
            usbfs_memory_mb=usbfs_memory_mb,
            direct_memory=direct_memory,
            own_processes=own_processes,
        )
        self.root = Path(answer["root"])

    @property
    def environment(self) -> Mapping[str, str]:
        """For a process that is to see these cameras, and no others."""
        preload = ":".join(filter(None, (PRELOAD, os.environ.get("LD_PRELOAD", ""))))
        return {**os.environ, "LD_PRELOAD": preload, "UMOCKDEV_DIR": str(self.root)}

    def python(self, code: str, *arguments: str, timeout_s: float = 60.0) -> str:
        """Run Python code that sees the cameras; its standard output. Raises CalledProcessError."""
        command = [sys.executable, "-c", code, *arguments]
        done = subprocess.run(
            command, env=self.environment, stdout=subprocess.PIPE, text=True, check=True, timeout=timeout_s
        )
        return done.stdout

    def call(self, function: str, *args: Any, user: int | None = None, **kwargs: Any) -> Any:
        """The result of a function of `plain_client`, run where the cameras are seen; if need be as another user."""
        call = json.dumps({"args": args, "kwargs": kwargs, "user": user})
        command = [sys.executable, "-m", "plain_client", function, call]
        environment = {**self.environment, "PYTHONPATH": str(_HERE.parent)}
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True, timeout=60)
        return json.loads(done.stdout)

    def wait_for(self, condition: Callable[[Report], bool], camera: int = 0, seconds: float = 20.0) -> Report:
        """The first report that fulfils the condition. Raises TimeoutError."""
        deadline_s = time.monotonic() + seconds
        while time.monotonic() < deadline_s:
            report = self.report(camera)
            if condition(report):
                return report
            time.sleep(0.01)
        raise TimeoutError(f"not so within {seconds:g} s")

    def plug(self, camera: int = 0, port: str | None = None) -> None:
        """Plug a camera in, where it was or at another port."""
        self._ask(do="plug", camera=camera, port=port)

    def unplug(self, camera: int = 0) -> None:
        """Pull a camera out."""
        self._ask(do="unplug", camera=camera)

    def fault(self, fault: Fault, camera: int = 0) -> None:
        """Let something happen, at its frame or, if that has gone by, now."""
        self._ask(do="fault", camera=camera, **asdict(fault))

    def permit(self, mode: int, camera: int = 0) -> None:
        """Change the permissions of the device node."""
        self._ask(do="permit", camera=camera, mode=mode)

    def report(self, camera: int = 0) -> Report:
        """What the camera has done."""
        values = self._ask(do="report", camera=camera)
        values["sent"] = tuple(Run(*run) for run in values["sent"])
        values["handed_over"] = tuple((frame, time_s) for frame, time_s in values["handed_over"])
        values["done"] = tuple(fault["kind"] for fault in values["done"])
        values["requests"] = tuple((request["index"], request["length"]) for request in values["requests"])
        values["commands"] = tuple(values["commands"])
        return Report(**values)

    def hurry(self) -> None:
        """Before all that is not real-time: a camera is not kept waiting by a busy host. Raises PermissionError."""
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        for pid in (self._process.pid, *map(int, children)):
            os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(30))

    def close(self) -> None:
        """End the cameras."""
        self._process.communicate(timeout=20)

    def _ask(self, **command: Any) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the camera's process ended with {self._process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer
