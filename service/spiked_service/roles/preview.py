"""The preview worker: the newest frames as a picture, as often as a person can see a difference."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.blocks import aligned_window
from spiked.recon.mapping import fill_mosaic
from spiked.ring import End, Frames, Gap, Policy, RingReader
from spiked_service.images import ImageFormat, display_white, encode
from spiked_service.messages import PreviewOrder
from spiked_service.publication import write_atomically
from spiked_service.worker import Link

_BLOCKS = 4
"""Blocks of a picture; the nominal window leaves one at either end for the edge spikes."""
_PERIOD_S = 0.15
_WAIT_S = 0.1


def run_preview(order: PreviewOrder, link: Link) -> None:
    """Write the picture until the capture ends."""
    with RingReader.attach(order.ring, Policy.LATEST, "preview") as reader:
        blocks: list[NDArray[np.uint8]] = []
        first = 0
        while not link.stop.is_set():
            item = reader.next(_WAIT_S)
            match item:
                case End():
                    return
                case Gap():
                    blocks.clear()
                case Frames():
                    copied = np.array(item.data)
                    if not item.release():
                        blocks.clear()
                        continue
                    first = first if blocks else item.first
                    blocks.append(copied)
                case None:
                    continue
            if len(blocks) == _BLOCKS:
                _write(np.concatenate(blocks), first, reader, order.file)
                blocks.clear()
                link.leave.wait(_PERIOD_S)


def _write(frames: NDArray[np.uint8], first: int, reader: RingReader, file: Path) -> None:
    block, sensor = reader.geometry.block_frames, reader.geometry.sensor
    window = aligned_window(frames, sensor, first, first + block, first + len(frames) - block)
    channels = sensor.mosaic.channels(sensor.height, sensor.width) if sensor.mosaic else None
    image = fill_mosaic(window.rate(fill=True), channels)
    write_atomically(file, encode(image, ImageFormat.PNG, display_white(image)))
