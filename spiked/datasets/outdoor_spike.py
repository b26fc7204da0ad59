"""Outdoor-Spike: 33 sequences from a driving car, without labels."""

from dataclasses import replace
from pathlib import Path

from spiked.datasets.clip import Clip
from spiked.datasets.kind import UNKNOWN, DatasetKind
from spiked.datasets.spikes import files_in, recorded_clip
from spiked.recording import RecordingGeometry

SIZE, RATE_HZ, FRAMES = (400, 250), 40_000.0, 20_000
"""Size in pixels, frames a second, and frames of a sequence, as the authors state them."""


def recognises(folder: Path) -> bool:
    """Whether there are streams."""
    return bool(files_in(folder, ".dat"))


def read(folder: Path) -> tuple[Clip, ...]:
    """A clip for each sequence. Raises RecordingError."""
    given = RecordingGeometry(*SIZE, frame_rate_hz=RATE_HZ, flipped=True)
    return tuple(_noted(recorded_clip(folder, path, given)) for path in files_in(folder, ".dat"))


def _noted(clip: Clip) -> Clip:
    if clip.frames == FRAMES:
        return clip
    note = f"{clip.name}: {clip.frames} frames, and a sequence of the authors has {FRAMES}: it is cut, or not theirs"
    return replace(clip, notes=(*clip.notes, note))


KIND = DatasetKind(
    name="outdoor-spike",
    title="Outdoor-Spike",
    sensor="grey, 400x250 at 40 kHz, from a driving car",
    licence=UNKNOWN,
    size="33 sequences of 250 MB: 8.3 GB",
    published="https://github.com/Leozhangjiyuan/MDE-SpikingCamera (the README links the data)",
    get="follow the link to Outdoor-Spike in the README there; the password is given there",
    citation="J. Zhang et al., Spike Transformer: Monocular Depth Estimation for Spiking Camera, ECCV 2022",
    layout="""
*.dat: 20,000 frames of 12,500 bytes, LSB first, rows bottom-up
""",
    certainty="size, rate and length are stated by the authors; bit order and orientation are those of the camera",
    recognises=recognises,
    read=read,
)
