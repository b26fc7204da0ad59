"""Fields of the map's options by name: `--map-option`."""

import pytest
from spiked_service.settings.map_options import changed, map_option_names

from spiked.errors import ConfigurationError
from spiked.recon import MapOptions


def test_fields_and_their_parts_are_set_with_their_types() -> None:
    texts = ["sub_frames=0", "nuisances=false", "seeding.sure=0", "schedule.coarse_share=1e-9"]
    options = changed(MapOptions(), texts)
    assert (options.sub_frames, options.nuisances, options.seeding.sure) == (0, False, 0.0)
    assert options.schedule.coarse_share == 1e-9
    assert changed(options, ["sub_frames=none"]).sub_frames is None
    assert changed(MapOptions(), []) == MapOptions()


def test_every_name_can_be_set_to_its_default() -> None:
    for name in map_option_names():
        value: object = MapOptions()
        for part in name.split("."):
            value = getattr(value, part)
        if not isinstance(value, tuple):
            assert changed(MapOptions(), [f"{name}={'none' if value is None else value}"]) == MapOptions()


@pytest.mark.parametrize("text", ["nobody=1", "ssim", "ssim=much", "ssim=nan", "sub_frames=0.5", "seeding=1", "loss=x"])
def test_what_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="--map-option"):
        changed(MapOptions(), [text])
