"""Which rasteriser one gets."""

import pytest
import render_scenes as scenes

from spiked.errors import ConfigurationError
from spiked.render import Rasteriser, cuda, rasteriser_for


def test_the_cpu_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_RENDER", "cpu")
    assert isinstance(rasteriser_for(scenes.camera(), 1), Rasteriser)


def test_the_best_one_without_asking(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPIKED_RENDER", raising=False)
    best = Rasteriser if cuda.missing() else cuda.CudaRasteriser
    assert isinstance(rasteriser_for(scenes.camera(), 1), best)


def test_a_wish_that_cannot_be_met_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_RENDER", "abacus")
    with pytest.raises(ConfigurationError, match="abacus"):
        rasteriser_for(scenes.camera(), 1)
    if cuda.missing():
        monkeypatch.setenv("SPIKED_RENDER", "cuda")
        with pytest.raises(ConfigurationError, match="GPU"):
            rasteriser_for(scenes.camera(), 1)
