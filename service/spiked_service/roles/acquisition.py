"""The acquisition worker: a source into a ring, and nothing else."""

import logging

from spiked_driver.acquisition import acquire
from spiked_driver.realtime import take_priority
from spiked_driver.spec import is_camera, open_source

from spiked.ring import RingWriter
from spiked_service.messages import AcquisitionOrder, RingOpened
from spiked_service.worker import Link

_SLOTS_UNHURRIED = 64
"""A source that waits stays this little ahead of the slowest consumer, so that what is seen live belongs together."""


def run_acquisition(order: AcquisitionOrder, link: Link) -> None:
    """Raises SourceError, RecordingError or RingError, which end the capture."""
    source = open_source(order.source)
    sensor = source.sensor
    limit = order.frames if order.seconds is None else max(1, round(order.seconds * sensor.frame_rate_hz))
    with RingWriter.create(sensor, slots=_SLOTS_UNHURRIED if source.waits else None, ring_id=order.ring_id) as writer:
        link.tell(
            RingOpened(
                name=writer.name,
                width=sensor.width,
                height=sensor.height,
                frame_rate_hz=sensor.frame_rate_hz,
                frames=limit if limit is not None else source.frames,
                intrinsics=sensor.intrinsics,
                unhurried=source.waits,
            )
        )
        if is_camera(order.source):
            for note in take_priority():
                logging.getLogger(__name__).warning("%s", note)
        acquire(source, writer, link.stop, limit_frames=limit, consumers=order.consumers)
