"""The colour mosaic of a recording, detected from its pixels."""

from dataclasses import replace

from spiked.recon.frontend.mosaic_check import detect
from spiked.recon.frontend.windowing import Windows
from spiked.recording import Recording
from spiked.sensor import Mosaic, Sensor

_FRAMES = 160
"""Frames at the start by which it is detected."""
_WINDOW_FRAMES = 32
"""Frames of a view."""


def by_pixels(recording: Recording, sensor: Sensor) -> tuple[Sensor, str | None]:
    """The sensor with the mosaic that the first frames show, and what the user is to be asked about it.

    There is no question where the pixels agree with what is stated.
    """
    frames = recording.read(0, min(recording.frames, _FRAMES))
    windows = Windows(sensor, min(_WINDOW_FRAMES, len(frames)))
    view = next(iter([*windows.feed(0, frames), *windows.flush()]))
    found = detect(view.rate, sensor.mosaic)
    if found is sensor.mosaic:
        return sensor, None
    stated = "grey" if sensor.mosaic is None else sensor.mosaic
    other = {Mosaic.BGGR: "RGGB", Mosaic.RGGB: "BGGR", Mosaic.GBRG: "GRBG", Mosaic.GRBG: "GBRG", None: ""}[found]
    question = (
        "the pixels show no mosaic: the sensor is taken as grey"
        if found is None
        else f"by its pixels the mosaic is {found} or {other}, and they cannot say which (stated: {stated}): {found} "
        f"is taken; if red and blue are exchanged, state the mosaic {other}"
    )
    return replace(sensor, mosaic=found), question
