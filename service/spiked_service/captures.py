"""All captures of a service."""

import threading
from pathlib import Path
from urllib.parse import urlencode

from spiked_driver import open_source

from spiked.errors import ConfigurationError, SpikedError
from spiked_service.capture import Capture, Plan

_CLOSE_S = 1.0
"""Workers end by themselves within 0.8 s of their dismissal; those that do not are killed."""


class UnknownCaptureError(SpikedError):
    """There is no capture with this id."""


class BusyError(SpikedError):
    """Another capture is running, or the service is ending."""


class Captures:
    """Starts captures, one at a time, and remembers those that are over."""

    def __init__(self, runtime: Path) -> None:
        self._runtime = runtime
        self._lock = threading.Lock()
        self._captures: dict[str, Capture] = {}
        self._closing = False

    def start(self, plan: Plan) -> Capture:
        """Raises BusyError while another capture runs, and when the service is about to end; SourceError,
        RecordingError or ConfigurationError for a source that cannot be captured from."""
        _check(plan)
        with self._lock:
            if self._closing:
                raise BusyError("the service is about to end; start it again to capture")
            for other in self._captures.values():
                if not other.snapshot().state.over:
                    raise BusyError(f"capture {other.id} is still running: stop it, or wait for its end")
            capture = Capture(plan, self._runtime)
            self._captures[capture.id] = capture
            return capture

    def get(self, capture_id: str) -> Capture:
        """Raises UnknownCaptureError."""
        with self._lock:
            try:
                return self._captures[capture_id]
            except KeyError as error:
                raise UnknownCaptureError(f"there is no capture {capture_id}; GET captures lists them") from error

    def all(self) -> list[Capture]:
        """Oldest first."""
        with self._lock:
            return list(self._captures.values())

    def dismiss(self) -> None:
        """Tell every worker to leave at once; no capture can be started any more."""
        with self._lock:
            self._closing = True
            captures = list(self._captures.values())
        for capture in captures:
            capture.dismiss()

    def close(self) -> None:
        """End every worker, within a moment."""
        self.dismiss()
        for capture in self.all():
            capture.join(_CLOSE_S)


def _check(plan: Plan) -> None:
    """Refuse at once what would fail a moment later in a worker."""
    sensor = open_source(plan.source).sensor
    if sensor.intrinsics is None and plan.intrinsics is None:
        raise ConfigurationError(
            f"the focal length of {plan.source} is not known: give intrinsics (fx, fy, cx, cy) with the capture, "
            "as `spiked serve --intrinsics`, in a recording's sidecar, or as a camera's field of view (usb0?fov=40)"
        )


def unhurried(source: str) -> str:
    """The source with `pace=0` unless it names a pace: files and simulations then wait for the reconstruction.

    A real camera cannot wait; a replay at its recorded rate, which loses what is not taken in time, is `pace=1`.
    """
    kind, _, query = source.partition("?")
    if not kind.startswith(("replay:", "sim:")) or "pace=" in query:
        return source
    return f"{kind}?{query}&{urlencode({'pace': 0})}" if query else f"{kind}?pace=0"
