"""Images of the API: PNG divided by white, EXR in radiance."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from spiked_service.results.image_encoding import ImageFormat, encode


@pytest.mark.parametrize("channels", [1, 3])
def test_png_divides_by_white_and_clips(channels: int) -> None:
    radiance = np.linspace(0, 0.6, 30 * 40 * channels, dtype=np.float32).reshape(30, 40, channels)
    png = np.frombuffer(encode(radiance, ImageFormat.PNG, white=0.5), np.uint8)
    decoded = cv2.imdecode(png, cv2.IMREAD_UNCHANGED).reshape(30, 40, channels)[..., ::-1]
    np.testing.assert_allclose(decoded, np.clip(radiance / 0.5, 0, 1) * 255, atol=0.51)


def test_exr_keeps_radiance_exactly(tmp_path: Path) -> None:
    oiio = pytest.importorskip("OpenImageIO")
    radiance = np.random.default_rng(0).random((20, 30, 1), np.float32) * 3
    path = tmp_path / "view.exr"
    path.write_bytes(encode(radiance, ImageFormat.EXR, white=1.0))
    np.testing.assert_array_equal(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT), radiance)
