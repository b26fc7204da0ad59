"""Pictures of a calibration: what is known of each pixel."""

from enum import StrEnum

import numpy as np

from spiked.calibration import Calibration
from spiked_service.results.image_encoding import ImageFormat, display_white, encode

_GAIN_RANGE = 0.5
"""Gains from 1 minus this, black, to 1 plus this, white."""


class CalibrationPicture(StrEnum):
    """What a picture of a calibration shows."""

    GAIN = "gain"
    """Relative sensitivity: grey is the mean, black and white are 0.5 less and more."""
    DARK = "dark"
    """Spikes a frame without light; white is the 99.5th percentile."""
    USELESS = "useless"
    """White: pixels that are left out."""


def calibration_picture(calibration: Calibration, kind: CalibrationPicture) -> bytes:
    """A PNG of the sensor's size."""
    if kind is CalibrationPicture.GAIN:
        return encode((calibration.gain - (1 - _GAIN_RANGE)) / (2 * _GAIN_RANGE), ImageFormat.PNG, 1.0)
    if kind is CalibrationPicture.DARK:
        return encode(calibration.dark, ImageFormat.PNG, display_white(calibration.dark))
    return encode(calibration.dead.astype(np.float32), ImageFormat.PNG, 1.0)
