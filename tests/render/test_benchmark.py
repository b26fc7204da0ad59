"""The benchmark measures what it states; no figure has a bound here."""

import numpy as np

from spiked.render import Rasteriser, benchmark


def test_the_naive_renderer_draws_the_same_picture() -> None:
    camera, splats = benchmark.scene(benchmark.Size(150, 64, 40))
    image = Rasteriser(camera, 1).forward(splats, np.eye(3)[None], np.zeros((1, 3)))
    assert np.abs(image.values - benchmark.naive_image(camera, splats)).max() < 1e-4


def test_every_row_is_a_positive_number() -> None:
    rows = benchmark.measure((benchmark.Size(300, 64, 40),), repetitions=1)
    assert len({(row.name, row.threads) for row in rows}) == len(rows)
    assert all(row.value > 0 for row in rows)
    steps = [row for row in rows if row.name.startswith("step")]
    assert steps
    assert all(row.ratio is not None and row.ratio > 0 for row in steps)


def test_the_row_of_a_gpu() -> None:
    row = benchmark.on_device(benchmark.Size(300, 64, 40), repetitions=1, device="emulated")
    assert row.name == "step with Adam, 0k splats, 64x40, emulated GPU"
    assert row.value > 0 and row.ratio is not None and row.ratio > 0


def test_a_step_on_a_view_is_timed() -> None:
    for sub_frames in (0, 2):
        timing = benchmark.step_on_a_view(benchmark.Size(300, 64, 40), 1, sub_frames, device="emulated")
        assert timing.best_s > 0
