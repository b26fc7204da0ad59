"""Recordings: raw `.dat` files read by memory map, the sidecars that say what they hold, writing and checking them."""

from spiked.recording.geometry import Flavour, Origin, OriginKind
from spiked.recording.reader import Recording, open_recording
from spiked.recording.sidecar import ClockPair, Gap, Sidecar, read_sidecar, sidecar_path, write_sidecar
from spiked.recording.verify import Verdict, Verification, verify
from spiked.recording.writer import RecordingWriter

__all__ = [
    "ClockPair",
    "Flavour",
    "Gap",
    "Origin",
    "OriginKind",
    "Recording",
    "RecordingWriter",
    "Sidecar",
    "Verdict",
    "Verification",
    "open_recording",
    "read_sidecar",
    "sidecar_path",
    "verify",
    "write_sidecar",
]
