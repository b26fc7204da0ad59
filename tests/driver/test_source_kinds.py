"""The registry of source kinds: one line makes a kind that opens, lists and describes itself."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import Field
from spiked_driver import Chunk, FaultySource, acquire, open_source, source_kinds
from spiked_driver.source_kind import Device, PacedOptions, SourceKind, SourceSpec, Warn
from spiked_driver.source_kinds import KINDS, find_kind, is_camera, kind_of, known_devices

from spiked.camera import CameraOptions
from spiked.errors import SourceError
from spiked.ring import (
    DeviceState,
    DeviceStatus,
    End,
    EndReason,
    Frames,
    Gap,
    LossCause,
    Policy,
    RingReader,
    RingWriter,
)
from spiked.sensor import Sensor


class ToyOptions(PacedOptions):
    """Options of the toy."""

    value: int = Field(7, ge=0, le=255)
    """Byte that fills its frames."""


class ToySource:
    """Sixteen frames of one byte."""

    sensor = Sensor(64, 8, 1000.0)
    frames = 16
    can_block = True
    device_status = DeviceStatus(DeviceState.STREAMING)

    def __init__(self, value: int) -> None:
        self._value = value
        self._next = 0

    def open(self) -> None:
        self._next = 0

    def close(self) -> None:
        pass

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        if self._next == self.frames:
            return End(self.frames, EndReason.FINISHED)
        count = min(len(view), self.frames - self._next)
        view[:count] = self._value
        self._next += count
        return Chunk(self._next - count, count)


def open_toy(spec: SourceSpec, options: ToyOptions, warn: Warn | None) -> ToySource:
    return ToySource(options.value)


def describe_toy(spec: SourceSpec) -> Device:
    return Device(spec.text, "toy", f"a toy at {spec.target}")


TOY = SourceKind("toy", "toy:NAME", "a toy", ToyOptions, open_toy, describe_toy, can_block=True)


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source_kinds, "KINDS", [*KINDS, TOY])


def captured(spec: str) -> list[int | Gap]:
    """First bytes of the blocks of a capture, and its gaps."""
    source = open_source(spec)
    taken: list[int | Gap] = []
    with (
        RingWriter.create(source.sensor, slots=16, block_frames=4) as writer,
        RingReader.attach(writer.name, Policy.LOSSLESS, "test") as reader,
    ):
        assert acquire(source, writer, Never()) is EndReason.FINISHED
        while not isinstance(item := reader.next(1.0), End):
            assert item is not None
            if isinstance(item, Frames):
                with item as data:
                    taken.append(int(data[0, 0]))
            else:
                taken.append(item)
    return taken


class Never:
    """A stop event that is never set."""

    def is_set(self) -> bool:
        return False


@pytest.mark.usefixtures("toy")
def test_a_registered_kind_is_captured_from() -> None:
    assert captured("toy:desk?value=9") == [9, 9, 9, 9]


@pytest.mark.usefixtures("toy")
def test_a_registered_kind_takes_faults_by_its_options() -> None:
    assert isinstance(open_source("toy:desk?gap=4:4"), FaultySource)
    assert captured("toy:desk?gap=4:4") == [7, Gap(4, 4, LossCause.USB), 7, 7]


@pytest.mark.usefixtures("toy")
def test_a_registered_kind_is_listed_and_checked() -> None:
    assert Device("toy:desk", "toy", "a toy at desk") in known_devices(["toy:desk"])
    assert not is_camera("toy:desk")
    with pytest.raises(SourceError, match="option value=256: it must be less than or equal to 255"):
        open_source("toy:desk?value=256")
    with pytest.raises(SourceError, match="replay:FILE, sim: and toy:NAME"):
        open_source("parallel:")


def test_an_unregistered_kind_is_unknown(tmp_path: Path) -> None:
    assert find_kind("toy:desk") is None
    unknown = known_devices(["toy:desk"])[0]
    assert (unknown.kind, unknown.source) == ("toy", "toy:desk")
    assert "no kind 'toy'" in unknown.reason


@pytest.mark.parametrize(
    ("spec", "name"),
    [
        ("usb0", "usb"),
        ("usb0?fov=4", "usb"),
        ("usb:2-1.4", "usb"),
        ("pcie:/dev/a:b?rate=1", "pcie"),
        ("sim:", "sim"),
        ("sim", None),
        ("usbx", None),
    ],
)
def test_the_text_names_its_kind(spec: str, name: str | None) -> None:
    kind = find_kind(spec)
    assert (kind.name if kind else None) == name


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_every_option_has_a_description_in_its_schema(kind: SourceKind) -> None:  # type: ignore[type-arg]
    for name, option in kind.options.model_json_schema()["properties"].items():
        assert option.get("description"), name


def test_the_options_of_a_simulation_begin_with_its_camera() -> None:
    """Forms and help show them in this order: size and motion before noise, faults and pace at the end."""
    names = list(kind_of("sim:").options.model_fields)
    assert names[:6] == list(CameraOptions.model_fields)
    wanted = ["width", "motion", "electrons_a_spike", "flicker", "drop", "pace"]
    assert [name for name in names if name in wanted] == wanted


@pytest.mark.parametrize("source", ["usb0", "pcie:/dev/none"])
def test_a_camera_says_whether_it_has_triggers_and_ptp(source: str) -> None:
    capabilities = kind_of(source).describe(SourceSpec.parse(source)).capabilities
    assert [str(capabilities[name]) for name in ("trigger_input", "trigger_output", "ptp")] == ["not supported"] * 3
