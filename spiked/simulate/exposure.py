"""Frames of a simulated sensor, any number at a time, from spans of light."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from spiked.simulate.sensor import SpikeSensor
from spiked.simulate.spans import Span


class Exposure:
    """Exposes a sensor to spans, one after the other."""

    def __init__(self, spikes: SpikeSensor, spans: Iterator[Span]) -> None:
        self._spikes = spikes
        self._spans = spans
        self._left: Span | None = None

    def next_frames(self, count: int) -> NDArray[np.uint8]:
        """The next frames as stored, uint8 [count, frame_bytes]; fewer if the light ends."""
        out = np.empty((count, self._spikes.sensor.frame_bytes), np.uint8)
        done = 0
        while done < count:
            span = self._left or next(self._spans, None)
            if span is None:
                break
            take = min(count - done, len(span.weights))
            self._spikes.expose(span.first, span.last, span.weights[:take], out[done : done + take])
            rest = span.weights[take:]
            self._left = Span(span.first, span.last, rest) if len(rest) else None
            done += take
        return out[:done]
