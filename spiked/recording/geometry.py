"""Geometry of a recording: stated by a caller, or guessed from the file's size if there is no sidecar."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from spiked.camera import StoredCameraOptions
from spiked.errors import RecordingError
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Response, Sensor

DEFAULT_RATE_HZ = 20_000.0
"""Frame rate where neither sidecar nor options state one: that of both cameras."""

Assumable = Literal["frame_rate", "flipped", "bit_order"]
"""Fields of a sidecar for which there is a default if nobody states them."""
ASSUMABLE: tuple[Assumable, ...] = get_args(Assumable)
"""All of them."""


@dataclass(frozen=True)
class RecordingGeometry:
    """Geometry stated by a caller. A stated field overrides the sidecar; None: not stated."""

    width: int | None = None
    """Pixels in a row."""
    height: int | None = None
    """Rows."""
    frame_rate_hz: float | None = None
    layout: Layout | None = None
    bit_order: BitOrder | None = None
    flipped: bool | None = None
    """Rows are stored bottom-up."""
    mosaic: Mosaic | None = None
    """Colour filter pattern of the upright image."""
    intrinsics: Intrinsics | None = None
    response: Response | None = None
    """How light becomes spikes."""

    @classmethod
    def of(cls, options: StoredCameraOptions) -> "RecordingGeometry":
        """What the options state; a field of view needs the size, see `StoredCameraOptions.sensor`."""
        return cls(
            options.width,
            options.height,
            options.rate,
            options.layout,
            options.bit_order,
            options.flipped,
            options.mosaic,
            None if options.intrinsics is None else options.intrinsics.intrinsics(),
            options.response,
        )

    def stated(self) -> dict[str, Any]:
        """The stated fields by name: keyword arguments of `open_recording` and `verify`, fields of `Sensor`."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def unstated(self, assumed: Iterable[Assumable]) -> tuple[Assumable, ...]:
        """Those of the `assumed` fields that are not stated here."""
        stated = {"frame_rate": self.frame_rate_hz, "flipped": self.flipped, "bit_order": self.bit_order}
        return tuple(name for name in assumed if stated[name] is None)

    @property
    def states_size(self) -> bool:
        """Whether a field is stated that changes the bytes of a frame: width, height or layout."""
        return any(value is not None for value in (self.width, self.height, self.layout))


def orientation_questions(assumed: Iterable[Assumable], sensor: Sensor) -> tuple[str, ...]:
    """The question to the user where the direction of the rows is assumed.

    No pixel shows it: a world that is mirrored is as consistent as the true one.
    """
    if "flipped" not in assumed:
        return ()
    taken, option, value = ("bottom-up", "--upright", "false") if sensor.flipped else ("top-down", "--flipped", "true")
    return (
        f"nothing says which way up its rows come, and its pixels cannot: {taken} is taken; if writing in a picture "
        f"reads mirrored, give {option} (in a profile, a source or a request: flipped {value})",
    )


class OriginKind(StrEnum):
    """Source of a recording's geometry."""

    GIVEN = "given"
    SIDECAR = "sidecar"
    GUESSED = "guessed"


@dataclass(frozen=True)
class Origin:
    """Source of a recording's geometry, and a sentence that describes it."""

    kind: OriginKind
    sentence: str


@dataclass(frozen=True)
class Format:
    """A known size and layout of recordings."""

    width: int
    height: int
    frame_bytes: int
    layout: Layout | None
    """None: known, but not readable by this library."""
    name: str


class Flavour(Enum):
    """Known formats of frame data: A to C of the USB3 camera, D and E of the PCIe camera, F of simulated sets."""

    A = Format(400, 250, 12_500, Layout.COMPACT, "compact 400x250")
    B = Format(400, 250, 13_000, Layout.ROW_TAGGED, "row-tagged 400x250")
    C = Format(400, 250, 13_016, None, "USB3 wire data 400x250")
    D = Format(1000, 1000, 125_000, Layout.COMPACT, "compact 1000x1000")
    E = Format(1000, 1000, 128_000, None, "PCIe capture 1000x1000")
    F_600 = Format(600, 400, 30_000, Layout.COMPACT, "simulated 600x400")
    F_640 = Format(640, 360, 28_800, Layout.COMPACT, "simulated 640x360")
    F_320 = Format(320, 180, 7_200, Layout.COMPACT, "simulated 320x180")
    F_1280 = Format(1280, 720, 115_200, Layout.COMPACT, "simulated 1280x720")


WIRE_MAGIC = bytes.fromhex("00636063")
"""First bytes of a frame header of the USB3 camera."""


def tags_agree(frames: NDArray[np.uint8], height: int, row_bytes: int) -> NDArray[np.bool_]:
    """Whether the row numbers of row-tagged frames, uint8 [n, frame_bytes], are 0..height - 1: bool [n]."""
    tags = frames.reshape(len(frames), height, row_bytes + 2)[:, :, row_bytes:]
    numbers = tags[..., 0] + 256 * tags[..., 1].astype(np.uint16)
    agree: NDArray[np.bool_] = (numbers == np.arange(height, dtype=np.uint16)).all(axis=1)
    return agree


def guess(name: str, data: NDArray[np.uint8]) -> Format:
    """The one known format whose frames fill `data` (the file's bytes) exactly; `name` is for messages.

    The row-tagged format is recognised by its row numbers, the others by size only. Raises RecordingError if none or
    several fit.
    """
    tagged: Format = Flavour.B.value
    if data.size >= tagged.frame_bytes:
        head = data[: tagged.frame_bytes][None]
        if tags_agree(head, 250, 50).all():
            return tagged
        last_row = data[tagged.frame_bytes - 2 : tagged.frame_bytes]
        if data.size % tagged.frame_bytes == 0 and last_row.tobytes() == (249).to_bytes(2, "little"):
            raise RecordingError(
                f"{name}: this looks row-tagged 400x250, but the row numbers of frame 0 are not 0..249: the file is "
                "damaged; cut the damaged frames off, or give its layout and geometry"
            )
    if WIRE_MAGIC in data[: 4 * Flavour.C.value.frame_bytes].tobytes() and data.size % 12_500:
        raise RecordingError(f"{name}: this looks like {Flavour.C.value.name}, which `spiked convert` unpacks")
    fits: list[Format] = [f.value for f in Flavour if data.size % f.value.frame_bytes == 0 and f is not Flavour.B]
    readable = [f for f in fits if f.layout is not None]
    if len(readable) == 1:
        return readable[0]
    if not readable:
        known = f"; it would fit {fits[0].name}, which cannot be read" if fits else ""
        raise RecordingError(f"{name}: {data.size} bytes fit no known flavour{known}; give its width and height")
    options = " or ".join(f"{f.name} ({data.size // f.frame_bytes} frames)" for f in readable)
    raise RecordingError(f"{name}: {data.size} bytes may be {options}; give its width and height")
