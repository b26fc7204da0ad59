"""Sources by a line of text: `replay:FILE?pace=1&repeat=2&range=0:8000`, `sim:?seed=1&seconds=2`, `usb0?fov=40`, ...

The kinds are in `source_kinds`, and each checks its options: a source that `open_source` returns can be captured from.
"""

from typing import TypeVar
from urllib.parse import parse_qs

from pydantic import BaseModel, ValidationError

from spiked.errors import SourceError
from spiked_driver.fault_options import FaultOptions
from spiked_driver.faults import Faults, FaultySource
from spiked_driver.source import Source
from spiked_driver.source_kind import SourceSpec, Warn
from spiked_driver.source_kinds import kind_of

MOST_PIXELS = 1 << 22
"""Upper bound of a frame's pixels: four times those of the largest camera."""

_Options = TypeVar("_Options", bound=BaseModel)


def open_source(spec: str, warn: Warn | None = None) -> Source:
    """The source that a line of text names; `open` it to start. Raises SourceError or RecordingError in one line.

    `warn` gets one sentence for each fault that the capture survives.
    """
    kind, parts = kind_of(spec), SourceSpec.parse(spec)
    options = _parse(kind.options, parts.query, spec)
    source = kind.open(parts, options, warn)
    if not isinstance(options, FaultOptions):
        return source
    faults = options.faults(source.sensor.frame_rate_hz)
    return source if faults == Faults(seed=faults.seed) else FaultySource(source, faults)


def _parse(kind: type[_Options], query: str, spec: str) -> _Options:
    values = {
        name.replace("-", "_"): texts if len(texts) > 1 else texts[0]
        for name, texts in parse_qs(query, keep_blank_values=True).items()
    }
    try:
        options = kind.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = first["loc"][0]
        if first["type"] == "extra_forbidden":
            raise SourceError(
                f"source {spec!r} has no option {where}: there are {', '.join(kind.model_fields)}"
            ) from error
        problem = first["msg"].removeprefix("Value error, ").replace("Input should be", "it must be")
        raise SourceError(f"source {spec!r}: option {where}={values[str(where)]}: {problem}") from error
    width, height = getattr(options, "width", None) or 1, getattr(options, "height", None) or 1
    if width * height > MOST_PIXELS:
        raise SourceError(
            f"source {spec!r}: frames of {width}x{height} are larger than {MOST_PIXELS} pixels: choose smaller ones"
        )
    return options
