"""Public names that changed are available under their former names for one release, with a warning."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from spiked_driver import Faults, FaultySource, Loss, Source, acquire, open_source

import spiked.ring
from spiked.ring import DeviceState, DeviceStatus, LossCause, Policy, Ring, RingLayout, RingReader, RingWriter
from spiked.sensor import Sensor
from spiked.simulate import Room

SENSOR = Sensor(16, 4, 1000.0)


@contextmanager
def warned(former: str, current: str) -> Iterator[None]:
    """Checks that the block warns of exactly this name."""
    with pytest.warns(DeprecationWarning, match=f"{former} is now {current}$") as found:
        yield
    assert [warning.filename for warning in found] == [__file__]


@pytest.mark.parametrize(
    ("former", "current"), [("Cause", LossCause), ("Condition", DeviceStatus), ("Geometry", RingLayout)]
)
def test_classes_of_the_ring(former: str, current: type) -> None:
    with warned(f"spiked.ring.{former}", current.__name__):
        assert getattr(spiked.ring, former) is current


def test_a_name_that_never_was_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Circle'"):
        spiked.ring.Circle  # noqa: B018


def test_device_status_of_a_ring() -> None:
    with RingWriter.create(SENSOR, slots=8) as writer:
        with warned("RingWriter.publish_condition", "publish_device_status"):
            writer.publish_condition(DeviceStatus(DeviceState.ARMED, "why"))  # type: ignore[attr-defined]
        with warned("RingWriter.has_room", "has_space"):
            assert writer.has_room()  # type: ignore[attr-defined]
        with warned("RingWriter.wait_for_room", "wait_for_space"):
            assert writer.wait_for_room(0.0)  # type: ignore[attr-defined]
        status = writer.status().writer
        with warned("WriterStatus.condition", "device_status"):
            assert status.condition == DeviceStatus(DeviceState.ARMED, "why")  # type: ignore[attr-defined]


def test_frames_that_a_reader_has_read() -> None:
    with RingWriter.create(SENSOR, slots=8) as writer, RingReader.attach(writer.name, Policy.LATEST, "one"):
        (status,) = writer.status().readers
        with warned("ReaderStatus.received", "frames_read"):
            assert status.received == status.frames_read == 0  # type: ignore[attr-defined]


def test_pictures_of_a_room() -> None:
    room = Room(colour=False, seed=0)
    with warned("Room.look", "render"):
        look: Callable[..., object] = getattr(room, "look")  # noqa: B009
    assert look == room.render


def test_grace_of_a_ring() -> None:
    with (
        warned("argument mourning_s of RingWriter.create", "takeover_grace_s"),
        RingWriter.create(SENSOR, slots=8, mourning_s=2.0) as writer,  # type: ignore[call-arg]
        warned("argument mourning_s of RingWriter.take_over", "takeover_grace_s"),
    ):
        RingWriter.take_over(writer.name, mourning_s=2.0)  # type: ignore[call-arg]


@pytest.mark.parametrize(
    ("former", "current", "arguments"),
    [("hold", "claim_for_successor", ("why",)), ("give_up", "abandon", ()), ("bury", "remove_dead_readers", ("one",))],
)
def test_methods_of_a_ring(former: str, current: str, arguments: tuple[str, ...]) -> None:
    with RingWriter.create(SENSOR, slots=8) as writer:
        ring = Ring.attach(writer.name)
        with warned(f"Ring.{former}", current):
            method: Callable[..., object] = getattr(ring, former)
        assert method == getattr(ring, current)
        method(*arguments)


@pytest.mark.parametrize("spec", ["usb0", "sim:?pace=max", "pcie:/dev/null", "sim:?gap=1:1"])
def test_attributes_of_sources(spec: str) -> None:
    source = open_source(spec)
    name = type(source).__name__
    with warned(f"{name}.waits", "can_block"):
        assert source.waits == source.can_block  # type: ignore[attr-defined]
    with warned(f"{name}.condition", "device_status"):
        assert source.condition == source.device_status  # type: ignore[attr-defined]


def test_nothing_of_ours_uses_a_former_name(recwarn: pytest.WarningsRecorder) -> None:
    source: Source = FaultySource(open_source("sim:?pace=max&width=16&height=8"), Faults((Loss(3, 2),)))
    with RingWriter.create(source.sensor, slots=8) as writer:
        acquire(source, writer, threading.Event(), limit_frames=8)
        assert Ring.attach(writer.name).status().writer.lost[LossCause.USB] == 2
    assert [str(warning.message) for warning in recwarn if warning.category is DeprecationWarning] == []
