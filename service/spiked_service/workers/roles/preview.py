"""The preview worker: renders images of the newest frames, at most one set every `_PERIOD_S`."""

import base64
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.blocks import aligned_window
from spiked.recon.frontend.demosaic import fill_mosaic
from spiked.recon.frontend.mosaic_check import layout_warnings
from spiked.ring import End, Frames, Gap, Policy, RingReader
from spiked.sensor import Sensor
from spiked.whole_files import write_atomically
from spiked_service.results.image_encoding import display_white, thumbnail
from spiked_service.results.rate_statistics import as_text, histogram_of
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import PreviewCommand, PreviewKind, PreviewTaken, Warned

_BLOCKS = 4
"""Blocks per image; the window excludes one at either end, whose spikes complete the intervals."""
_PERIOD_S = 0.15
"""Pause between two sets of images, seconds."""
_WAIT_S = 0.1
"""Longest wait for frames, seconds, so that the worker can leave."""
_MEMORY = 0.85
"""Weight of the accumulated image when another is added."""
_QUALITY = 85
"""WebP quality, 0 to 100."""

Image = NDArray[np.float32]


def run_preview(command: PreviewCommand, channel: WorkerChannel) -> None:
    """Render images until the capture ends."""
    with RingReader.attach(command.ring, Policy.LATEST, "preview") as reader:
        renderer = PreviewRenderer(reader.geometry.sensor, command.thumbnail)
        block = reader.geometry.block_frames
        blocks: list[NDArray[np.uint8]] = []
        first = 0
        while not channel.stop.is_set():
            item = reader.next(_WAIT_S)
            match item:
                case End():
                    break
                case Gap():
                    blocks.clear()
                case Frames():
                    copied = np.array(item.data)
                    if not item.release() or (blocks and item.count < block):
                        blocks.clear()
                        continue
                    first = first if blocks else item.first
                    blocks.append(copied)
                case None:
                    continue
            if len(blocks) == _BLOCKS:
                frames = np.concatenate(blocks)
                if len(frames) > 2 * block:
                    channel.send(renderer.render(frames, first, block))
                    if (warning := renderer.layout_warning()) is not None:
                        channel.send(Warned(text=warning))
                blocks.clear()
                channel.leave.wait(_PERIOD_S)
        renderer.keep(replace=True)


class PreviewRenderer:
    def __init__(self, sensor: Sensor, thumbnail: Path | None) -> None:
        self._sensor = sensor
        self._channels = sensor.mosaic.channels(sensor.height, sensor.width) if sensor.mosaic else None
        self._thumbnail = thumbnail
        self._accumulated: Image | None = None
        self._newest: Image | None = None
        self._kept_s: float | None = None
        self._images = 0
        self._warned = False

    def render(self, frames: NDArray[np.uint8], first: int, block: int) -> PreviewTaken:
        """Images of compact frames uint8 [n, frame_bytes] starting at index `first`."""
        window = aligned_window(frames, self._sensor, first, first + block, first + len(frames) - block)
        interval = window.rate(fill=True)
        counted = window.end - window.begin
        rate = window.count.astype(np.float32) / np.float32(counted)
        old = rate if self._accumulated is None else self._accumulated
        accumulated = (_MEMORY * old + (1 - _MEMORY) * rate).astype(np.float32)
        self._accumulated = accumulated
        self._newest = interval
        self.keep(replace=False)
        pictures: dict[PreviewKind, Image] = {
            PreviewKind.INTERVAL: interval,
            PreviewKind.RATE: rate,
            PreviewKind.ACCUMULATION: accumulated,
        }
        shown = {kind: fill_mosaic(picture, self._channels) for kind, picture in pictures.items()}
        white = {kind: display_white(picture) for kind, picture in shown.items()}
        return PreviewTaken(
            frame=(window.begin + window.end) // 2,
            width=self._sensor.width,
            height=self._sensor.height,
            white=white,
            images={kind: base64.b64encode(_webp(shown[kind], white[kind])).decode() for kind in shown},
            rate_histogram=histogram_of(rate),
            counts=as_text(window.count),
            counted=counted,
        )

    def layout_warning(self) -> str | None:
        """The first contradiction between the stated layout and the newest image, which is looked at now and then."""
        self._images += 1
        due = not self._warned and self._images.bit_count() == 1  # images 1, 2, 4, 8, ...
        warnings = layout_warnings(self._sensor, self._newest) if due and self._newest is not None else []
        self._warned |= bool(warnings)
        return warnings[0] if warnings else None

    def keep(self, *, replace: bool) -> None:
        """Write a thumbnail of the first image, and at the end of the last one."""
        if self._newest is None or self._thumbnail is None or (self._kept_s is not None and not replace):
            return
        self._kept_s = time.monotonic()
        write_atomically(self._thumbnail, thumbnail(fill_mosaic(self._newest, self._channels)))


def _webp(image: Image, white: float) -> bytes:
    """Radiance [H, W] or [H, W, C], C 1 or 3 (RGB), as lossy WebP."""
    pixels = (np.clip(np.nan_to_num(image) / white, 0, 1) * 255 + 0.5).astype(np.uint8)
    if pixels.ndim == 3 and pixels.shape[2] == 3:
        pixels = pixels[..., ::-1]
    _, encoded = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    return encoded.tobytes()
