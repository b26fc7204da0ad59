"""Recordings: raw `.dat` files and their sidecars. Reading by memory map, writing, checking and recovering."""

from spiked.recording.durability import LIVE, PLAIN, Durability, Sync
from spiked.recording.geometry import Flavour, Origin, OriginKind, RecordingGeometry
from spiked.recording.index import Index, index_path, read_index
from spiked.recording.reader import Recording, open_recording
from spiked.recording.recover import Recovered, recover
from spiked.recording.sidecar import (
    ClockPair,
    Gap,
    Sidecar,
    read_sidecar,
    recorded_calibration,
    sidecar_path,
    write_sidecar,
)
from spiked.recording.verify import Verdict, Verification, verify
from spiked.recording.writer import RecordingWriter, remove_recording, whole_recording

__all__ = [
    "LIVE",
    "PLAIN",
    "ClockPair",
    "Durability",
    "Flavour",
    "Gap",
    "Index",
    "Origin",
    "OriginKind",
    "Recording",
    "RecordingGeometry",
    "RecordingWriter",
    "Recovered",
    "Sidecar",
    "Sync",
    "Verdict",
    "Verification",
    "index_path",
    "open_recording",
    "read_index",
    "read_sidecar",
    "recorded_calibration",
    "recover",
    "remove_recording",
    "sidecar_path",
    "verify",
    "whole_recording",
    "write_sidecar",
]
