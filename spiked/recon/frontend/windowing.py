"""From frames as they arrive to views: spike-aligned rate images of short windows, with the noise of each pixel."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

import spiked.native._spikes as _spikes
from spiked.blocks import Window, aligned_window
from spiked.calibration import Calibration
from spiked.recon.frontend.motion_compensation import BINOMIAL, MotionCompensator, drift, speed
from spiked.recon.frontend.photon_counts import PhotonCounts
from spiked.recon.frontend.spike_intervals import SpikeIntervals
from spiked.recon.frontend.spike_targets import SpikeTarget, TargetKind, record_targets
from spiked.sensor import Image, Mosaic, Response, Sensor

SITE_SHARES = np.array([0.25, 0.5, 0.25], np.float32)
"""Share of the red, green and blue sites in a mosaic."""
MIN_EXPOSURE_SHARE = 0.7
"""Share of a pixel's exposure that has to lie in the span of most (decision 6)."""
MIN_EXPOSURE = 0.02
"""Shortest exposure of a pixel, in units of a sub-frame."""
SEARCH_FRAMES = 24
"""Frames on both sides of a window that are searched for the spikes nearest to its edges."""
BUFFER_RATIO = 4
"""Capacity of the frame buffer over the number of waiting frames."""
PROBE_FRAMES = 16
"""Frames of the first motion estimate."""
WINDOWS = (4, 8, 16, 32, 64)
"""Lengths of a view in frames (decision 2)."""
PHOTON_WINDOWS = (32, 64, 128, 256)
"""Lengths of a view of a single-photon camera in frames (decision 27)."""
FIRST_PHOTON_WINDOW = 256
"""Length of the first of these views, at most."""
PHOTON_NOISE, PHOTON_MOTION_PX = 0.07, 4.0
"""Noise of a pixel over twice the mean rate down to which such views are lengthened, and the motion in one above which
they are not, or are shortened (decision 27)."""
WARP_FRAMES = 12
"""Frames on either side of a view's middle that the map is fitted to where the motion is fast (decision 8)."""
FIRST_WINDOW = 16
"""Length of the first views in frames."""
WINDOW_MOTION_PX = (0.12, 0.6)
"""The next view is twice as long below the first motion in a view, half as long above twice the second (decision 2)."""
SPACING_PX, MOST_SPACING_S = 1.6, 0.005
"""Motion and time from one view of a long path to the next, at most, where single views see less motion: more views
cost time and add hardly any information (decision 15); a hand trembles at up to 12 Hz."""
MOTION_ONSET_PX = 1.0
"""Motion in a view longer than `FIRST_WINDOW` that shortens this view at once (decision 7)."""
FAST_PX = (0.35, 0.5)
"""Motion in px a frame: compensation starts above the second and ends below the first (decision 2). Below it 8-frame
windows give better tracks in spite of their blur: charge between spikes is far less noisy than warped spikes."""
FASTEST_PX = (0.45, 0.6)
"""Motion in px a frame: views of 4 instead of 8 frames start above the second and end below the first (decision 2)."""


@dataclass(frozen=True)
class View:
    """The frames [begin, end) as a rate image with its noise; images are upright [H, W]."""

    begin: int
    end: int
    intervals: SpikeIntervals | PhotonCounts
    """The spikes between which each pixel's charge was measured; how often it fired, of a single-photon camera."""
    spikes_a_pixel: float
    """Mean spike count of a pixel in the window."""
    calibration: Calibration | None = None
    """If given, rates are calibrated to light."""
    after_gap: bool = False
    """Frames are missing between the view before and this one."""
    sharp: Image | None = None
    """Motion-compensated spikes a frame at the middle of the window, all colours mixed; None for slow or unknown
    motion."""
    first: int = 0
    """Absolute index of the first of `frames`."""
    frames: NDArray[np.uint8] | None = None
    """Stored frames [n, frame_bytes] around the middle, if `sharp` is set; the map is fitted to all of them."""
    targets: tuple[SpikeTarget, ...] = ()
    """What else the map may be fitted to, one of a kind."""
    mosaic: Mosaic | None = None
    """Of the sensor."""
    shown: SpikeTarget | None = None
    """Rates, deviations and exposures are those of this target; None: of the charge between `intervals`."""

    def showing(self, kind: TargetKind | None) -> "View":
        """The view with rates, deviations and exposures of its target of that kind; None: of its intervals."""
        return replace(self, shown=next((one for one in self.targets if one.kind is kind), None))

    @property
    def _measured(self) -> SpikeIntervals | PhotonCounts | SpikeTarget:
        return self.intervals if self.shown is None else self.shown

    @property
    def time(self) -> float:
        """The middle of the window in frames."""
        return 0.5 * (self.begin + self.end)

    @cached_property
    def light(self) -> tuple[Image, Image]:
        """Rate and deviation, computed at the first access and cached."""
        measured = self._measured.rate(), self._measured.deviation()
        return measured if self.calibration is None else self.calibration.apply(*measured, self.mosaic)

    @property
    def rate(self) -> Image:
        """Spikes a frame; where no whole interval was seen, what is right in the mean of many windows."""
        return self.light[0]

    @property
    def deviation(self) -> Image:
        """Standard deviation of `rate`."""
        return self.light[1]

    @property
    def nbytes(self) -> int:
        """Bytes held by the view: spikes, the compensated image, and its share of the frames."""
        frames = 0 if self.frames is None else (self.end - self.begin) * self.frames.shape[1]
        sharp = 0 if self.sharp is None else self.sharp.nbytes
        return self.intervals.nbytes + frames + sharp + sum(target.nbytes for target in self.targets)

    def preview_rate(self, out: Image) -> Image:
        """`rate` as one picture shows it best, without caching; written to `out` if there is no calibration."""
        shown = self.intervals.picture(out)
        if self.calibration is None:
            return shown
        return self.calibration.apply(shown, self.intervals.deviation(), self.mosaic)[0]

    def exposure_times(self, parts: int) -> NDArray[np.float64]:
        """The times [parts + 1] in frames of the poses of `exposure`, evenly spaced over that of most pixels."""
        return self.time + np.linspace(*self._measured.span, parts + 1)

    def exposure(self, parts: int) -> tuple[NDArray[np.float64], Image, NDArray[np.bool_]]:
        """When each pixel gathered its charge, for `Rasteriser.forward_moving` with `parts` sub-frames.

        Returns `exposure_times`, the pixels' exposures [2, H, W] in units of sub-frames, and a mask [H, W], False for
        much longer exposures.
        """
        start, stop = self._measured.times()
        first, last = self._measured.span
        windows, seen = np.empty((2, *start.shape), np.float32), np.empty(start.shape, np.bool_)
        scale = parts / max(last - first, 1e-3)
        _spikes.exposures(
            start, stop, first, scale, parts, MIN_EXPOSURE, MIN_EXPOSURE_SHARE, windows, seen.view(np.uint8)
        )
        return self.exposure_times(parts), windows, seen


def make_view(
    window: Window,
    sensor: Sensor,
    after_gap: bool,
    calibration: Calibration | None = None,
    sharp: Image | None = None,
    first: int = 0,
    frames: NDArray[np.uint8] | None = None,
    targets: tuple[SpikeTarget, ...] = (),
) -> View:
    """The view of a window, in light instead of spikes where the camera is calibrated."""
    counted = sensor.response is Response.BERNOULLI
    intervals = PhotonCounts.of(window) if counted else SpikeIntervals.of(window)
    count = float(cv2.mean(window.count)[0])
    return View(
        window.begin, window.end, intervals, count, calibration, after_gap, sharp, first, frames, targets, sensor.mosaic
    )


class Windows:
    """Cuts a stream of frames into consecutive views of `length` frames; a window never spans a gap.

    Without a `length` it follows the motion, see `follow`. Fast motion is compensated in each view's `sharp` image.
    """

    def __init__(
        self,
        sensor: Sensor,
        length: int | None,
        calibration: Calibration | None = None,
        targets: tuple[TargetKind, ...] = (),
    ) -> None:
        """Each view records these `targets`. Raises CalibrationError when the calibration is of another
        sensor."""
        counted = sensor.response is Response.BERNOULLI
        self._wanted = float(PHOTON_WINDOWS[1])
        """Frames without which photons are too noisy."""
        self.sensor, self.sharpen = sensor, False
        self.length = length or (PHOTON_WINDOWS[1] if counted else FIRST_WINDOW)
        # Frames of a single-photon camera are too noisy to tell their motion from.
        self._follows, self._probed, self._sees_motion = length is None, length is not None, not counted
        self.spaced = False
        """Views lie up to `SPACING_PX` apart, and frames between them are left out."""
        self._spacing = 0
        """Frames from the middle of one view to that of the next, at least."""
        self._calibration, self._targets = calibration, targets
        if calibration is not None:
            calibration.check(sensor)
        self._store = np.zeros((0, sensor.frame_bytes), np.uint8)
        self._shared = False
        """Views reference the buffer, so that it must not be overwritten."""
        self._frames = self._store
        """Frames not yet consumed, the end of the filled part of the buffer."""
        self._filled = 0
        self._first = 0
        self._next = 0
        self._gap = False
        self._compensator: MotionCompensator | None = None
        self._window: Window | None = None

    def __getstate__(self) -> dict[str, object]:
        """For a checkpoint: of the buffer only what waits."""
        return vars(self) | {"_store": self._frames, "_filled": len(self._frames), "_shared": True, "_window": None}

    @property
    def waiting(self) -> tuple[int, NDArray[np.uint8]]:
        """The frames that later views still need, uint8 [n, frame_bytes], and the index of the first."""
        return self._first, self._frames

    def feed(self, first_frame: int, frames: NDArray[np.uint8]) -> Iterator[View]:
        """Add frames uint8 [n, frame_bytes] in stored layout and yield the completed views."""
        expected = self._first + len(self._frames)
        if first_frame != expected:
            yield from self._cut(final=True)
            self._gap = self._gap or expected > 0
            self._frames, self._first, self._next = self._frames[:0], first_frame, first_frame
            self._compensator = None
        self._append(frames)
        yield from self._cut(final=False)

    def _append(self, frames: NDArray[np.uint8]) -> None:
        """Append frames; a full buffer is compacted or replaced."""
        waiting, count = len(self._frames), len(self._frames) + len(frames)
        begin = self._filled - waiting
        if begin + count > len(self._store):
            if self._shared or 2 * count > len(self._store):
                self._store, self._shared = np.empty((BUFFER_RATIO * count, self.sensor.frame_bytes), np.uint8), False
            self._store[:waiting] = self._frames
            begin = 0
        self._store[begin + waiting : begin + count] = frames
        self._filled = begin + count
        self._frames = self._store[begin : self._filled]

    @property
    def latest_frames(self) -> int:
        """Number of frames that `latest_view` needs."""
        return self.length + 2 * SEARCH_FRAMES

    def latest_view(self, first_frame: int, frames: NDArray[np.uint8]) -> View:
        """One view in the middle of frames uint8 [n, frame_bytes]; waiting frames are dropped."""
        stop = first_frame + len(frames)
        length = min(self.length, len(frames))
        begin = first_frame + (len(frames) - length) // 2
        window = aligned_window(frames, self.sensor, first_frame, begin, begin + length)
        targets = self._record(frames, first_frame, window)
        view = make_view(window, self.sensor, self._gap, self._calibration, targets=targets)
        self._frames, self._first, self._next, self._gap = self._store[:0], stop, stop, False
        self._probed, self._compensator = True, None
        return view

    def flush(self) -> Iterator[View]:
        """The last views, without a margin after them."""
        yield from self._cut(final=True)

    def follow(self, motion_px: float, frames: float) -> None:
        """Set the length of the next views from an image motion of `motion_px` in `frames`: long views are less noisy,
        short ones less blurred."""
        if not self._follows or motion_px == 0:
            return
        speed_px = motion_px / frames
        most = MOST_SPACING_S * self.sensor.frame_rate_hz
        self._spacing = int(min(SPACING_PX / speed_px, most)) if self.spaced else 0
        self.sharpen = self._sees_motion and speed_px > FAST_PX[not self.sharpen]
        if self.sharpen:
            self.length = WINDOWS[0] if speed_px > FASTEST_PX[self.length > WINDOWS[0]] else WINDOWS[1]
            return
        if not self._sees_motion:
            fitting = [n for n in PHOTON_WINDOWS if n <= self._wanted and n * speed_px <= PHOTON_MOTION_PX]
            self.length = min(max([PHOTON_WINDOWS[0], *fitting]), 2 * self.length)
            return
        index = max(WINDOWS.index(self.length), 1)
        in_window = speed_px * self.length
        if in_window > 2 * WINDOW_MOTION_PX[1]:
            index = max(index - 1, 1)
        elif in_window < WINDOW_MOTION_PX[0]:
            index = min(index + 1, len(WINDOWS) - 1)
        self.length = WINDOWS[index]

    def _probe(self) -> None:
        """Estimate the motion of the first frames; only fast motion changes the view length."""
        if not self._sees_motion:
            fired = float(np.bitwise_count(self._frames[:PROBE_FRAMES]).mean()) / 8
            self._wanted = _frames_wanted(fired)
            self.length = max(
                n for n in PHOTON_WINDOWS if n <= max(min(self._wanted, FIRST_PHOTON_WINDOW), PHOTON_WINDOWS[0])
            )
            self._probed = True
            return
        speed_px = speed(self._frames[:PROBE_FRAMES], self.sensor)
        if speed_px > FAST_PX[1]:
            self.follow(speed_px, 1.0)
        self._probed = True

    def _begin(self, stop: int, final: bool) -> int:
        """Where the next view begins. The last one before `stop` is not farther from it than its length."""
        spaced = self._next + max(0, self._spacing - self.length)
        return max(self._next, min(spaced, stop - self.length)) if final else spaced

    def _shorten(self, begin: int) -> None:
        """Shorten a long view in which the camera starts to move: it would be blurred."""
        while self._follows and self._sees_motion and not self.sharpen and self.length > FIRST_WINDOW:
            frames = self._frames[begin - self._first : begin - self._first + self.length]
            if drift(frames, self.sensor) < MOTION_ONSET_PX:
                return
            self.length = WINDOWS[WINDOWS.index(self.length) - 1]

    def _cut(self, final: bool) -> Iterator[View]:
        stop = self._first + len(self._frames)
        if not self._probed and (len(self._frames) >= PROBE_FRAMES or final):
            self._probe()
        if not self._probed:
            return
        while (begin := self._begin(stop, final)) + self.length + (0 if final else SEARCH_FRAMES) <= stop:
            self._shorten(begin)
            end = begin + self.length
            low = max(self._first, begin - SEARCH_FRAMES)
            high = min(stop, end + SEARCH_FRAMES)
            part = self._frames[low - self._first : high - self._first]
            self._window = window = aligned_window(part, self.sensor, low, begin, end, out=self._window)
            sharp = self._sharp(0.5 * (begin + end), high)
            self._next = end
            if sharp is None and self.sharpen and final:
                continue  # the motion after the last frame is unknown, and a blurred view is worse than none
            first, frames = self._around((begin + end) // 2, stop) if sharp is not None else (0, None)
            targets = self._record(part, low, window)
            view = make_view(window, self.sensor, self._gap, self._calibration, sharp, first, frames, targets)
            if not self._sees_motion:
                self._wanted = _frames_wanted(view.spikes_a_pixel / (end - begin))
            yield view
            self._gap = False
        keep = max(self._first, min(self._next - SEARCH_FRAMES, stop))
        self._frames, self._first = self._frames[keep - self._first :], keep

    def _record(self, frames: NDArray[np.uint8], first_frame: int, window: Window) -> tuple[SpikeTarget, ...]:
        """The targets of a window, from the frames around it."""
        return record_targets(self._targets, frames, self.sensor, first_frame, window.begin, window.end)

    def _around(self, middle: int, stop: int) -> tuple[int, NDArray[np.uint8]]:
        """The frames around a time; views share their memory."""
        first, last = max(self._first, middle - WARP_FRAMES), min(stop, middle + WARP_FRAMES)
        self._shared = True
        return first, self._frames[first - self._first : last - self._first]

    def _sharp(self, time: float, stop: int) -> Image | None:
        if not self.sharpen:
            self._compensator = None
            return None
        if self._compensator is None or self._compensator.interval != self.length:
            self._compensator = MotionCompensator(self.sensor, self.length)
        self._compensator.estimate(self._frames[: stop - self._first], self._first, time)
        return self._compensator.sharp(self._frames, self._first, time)


def _frames_wanted(fired: float) -> float:
    """Frames that bring the noise of pixels, which fire with this mean probability, down to `PHOTON_NOISE`."""
    fired = min(max(fired, 1e-4), 0.999)
    flux = -np.log(1 - fired)
    return float(1.5 * fired / (1 - fired) / (2 * PHOTON_NOISE * flux) ** 2)


def grey(image: Image) -> Image:
    """Grey [h, w] of colours [h, w, 3] in the proportion of a mosaic's sites; grey images pass through."""
    return image if image.ndim == 2 else np.ascontiguousarray(image @ SITE_SHARES)


def luminance(rate: Image, mosaic: Mosaic | None) -> Image:
    """A grey image of raw sites: a 3x3 binomial mean sees every colour in the same proportion at every pixel."""
    if mosaic is None:
        return rate
    return np.asarray(
        cv2.sepFilter2D(rate, cv2.CV_32F, BINOMIAL, BINOMIAL, borderType=cv2.BORDER_REFLECT_101), np.float32
    )
