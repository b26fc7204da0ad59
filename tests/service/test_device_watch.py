"""Devices tell the bus when their state changes, and only then."""

from pathlib import Path

from spiked_service.api.announce import BusAnnouncer
from spiked_service.api.devices import DeviceWatch
from spiked_service.api.sources import Sources
from spiked_service.events import Bus, Topic
from spiked_service.keeping import Keeping
from spiked_service.live import LiveSettings
from spiked_service.store.rows import Plan

from .survival import over, random_recording, received, wait_for


def test_a_device_that_streams_and_rests_is_told_once_each_time(tmp_path: Path) -> None:
    random_recording(tmp_path / "noise.dat", 500)
    source = f"replay:{tmp_path / 'noise.dat'}?repeat=9999"
    bus = Bus()
    keeping = Keeping(tmp_path / "data", BusAnnouncer(bus))
    watch = DeviceWatch(keeping.captures, Sources(LiveSettings({"devices": [source]})), bus)
    heard = bus.subscribe([Topic.DEVICE])

    def states() -> list[tuple[str, str | None]]:
        watch.look()
        found = []
        while (message := heard.take()) is not None:
            told = message.payload.model_dump()
            if told["id"] == source:
                found.append((str(told["state"]), told["capture_id"]))
        return found

    try:
        assert states() == [("idle", None)]
        assert states() == []
        capture_id = keeping.captures.start(Plan(source, reconstruct=False)).id
        wait_for(lambda: received(keeping, capture_id) > 100, "frames come")
        assert states()[-1] == ("streaming", capture_id)
        assert states() == []
        keeping.captures.stop(capture_id)
        over(keeping, capture_id)
        assert states() == [("idle", None)]
    finally:
        keeping.close()
