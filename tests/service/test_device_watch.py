"""Devices tell the bus when their state changes, and only then."""

from pathlib import Path

from spiked_service.api.bus_notifier import BusNotifier
from spiked_service.api.routes.devices import DeviceWatch
from spiked_service.api.sources import Sources
from spiked_service.daemon import open_data_store
from spiked_service.events.bus import Bus, Topic
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.store.rows import Plan
from waiting import until

from .survival import over, random_recording, received


def test_a_device_that_streams_and_rests_is_told_once_each_time(tmp_path: Path) -> None:
    random_recording(tmp_path / "noise.dat", 500)
    source = f"replay:{tmp_path / 'noise.dat'}?repeat=9999"
    bus = Bus()
    data_store = open_data_store(tmp_path / "data", BusNotifier(bus))
    watch = DeviceWatch(data_store.captures, Sources(ReloadableSettings({"devices": [source]})), bus)
    heard = bus.subscribe([Topic.DEVICE])

    def states() -> list[tuple[str, str | None]]:
        watch.check()
        found = []
        while (message := heard.take()) is not None:
            told = message.payload.model_dump()
            if told["id"] == source:
                found.append((str(told["state"]), told["capture_id"]))
        return found

    try:
        assert states() == [("idle", None)]
        assert states() == []
        capture_id = data_store.captures.start(Plan(source, reconstruct=False)).id
        until(lambda: received(data_store, capture_id) > 100, "frames come")
        assert states()[-1] == ("streaming", capture_id)
        assert states() == []
        data_store.captures.stop(capture_id)
        over(data_store, capture_id)
        assert states() == [("idle", None)]
    finally:
        data_store.close()
