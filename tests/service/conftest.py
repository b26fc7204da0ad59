"""What tests of several modules of the service share."""

from collections.abc import Iterator

import pytest
from spiked_service.captures.archive import DataStore
from spiked_service.store.rows import Plan

from .survival import kept, moving_recording, over


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[DataStore, str]]:
    """A service, and a capture of it that has a recording and no reconstruction."""
    folder = tmp_path_factory.mktemp("house")
    with kept(folder / "data") as data_store:
        plan = Plan(f"replay:{moving_recording(folder / 'moving.dat')}?pace=0", reconstruct=False)
        yield data_store, over(data_store, data_store.captures.start(plan).id).id
