"""Views that are built anew from a recording equal the first ones."""

from pathlib import Path

import numpy as np
import pytest

from spiked.recon.frontend.recorded_views import ViewFrames, build_view
from spiked.recon.frontend.windowing import View, Windows
from spiked.recording import Recording, RecordingWriter, open_recording
from spiked.sensor import Layout, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

FRAMES, GAP_FIRST, GAP_FRAMES = 360, 150, 40


def record(path: Path, sensor: Sensor, flow_px: float) -> Recording:
    """A recording of the built-in room with a gap."""
    camera = SimulatedCamera(sensor.compact(), seed=1, motion=MotionKind.ARC, flow_px=flow_px)
    frames = camera.next_frames(FRAMES)
    with RecordingWriter(path, sensor) as writer:
        writer.append(frames[:GAP_FIRST])
        writer.gap(GAP_FIRST, GAP_FRAMES, "usb")
        writer.append(frames[GAP_FIRST + GAP_FRAMES :])
    return open_recording(path)


def views(recording: Recording, motion_px: float) -> list[View]:
    """All views of a recording, tracked at that motion in px a frame."""
    windows, found = Windows(recording.sensor, None), list[View]()
    for row in range(0, recording.frames, 50):
        index, count = recording.capture_index(row), min(50, recording.frames - row)
        count = min(count, GAP_FIRST - index) if index < GAP_FIRST else count
        for view in windows.feed(index, recording.read(row, count)):
            found.append(view)
            windows.follow(motion_px * (view.end - view.begin), view.end - view.begin)
    return [*found, *windows.flush()]


@pytest.mark.parametrize(("flow_px", "layout"), [(0.1, Layout.ROW_TAGGED), (0.8, Layout.COMPACT)])
def test_a_view_is_built_anew_as_it_was(tmp_path: Path, flow_px: float, layout: Layout) -> None:
    sensor = Sensor(160, 104, 20_000.0, layout=layout)
    recording = record(tmp_path / "room.dat", sensor, flow_px)
    found = views(recording, flow_px)
    assert len(found) > 10 and any(view.after_gap for view in found)
    compared = []
    for view in found:
        again = build_view(ViewFrames.of(view), recording, sensor, sharp=True)
        assert again is not None
        assert ViewFrames.of(again) == ViewFrames.of(view)
        assert again.spikes_a_pixel == view.spikes_a_pixel
        np.testing.assert_array_equal(again.rate, view.rate)
        np.testing.assert_array_equal(again.deviation, view.deviation)
        np.testing.assert_array_equal(again.frames, view.frames)
        if view.sharp is not None:
            compared.append(again.sharp is not None and np.allclose(again.sharp, view.sharp, atol=0.02))
    assert bool(compared) == (flow_px > 0.5)
    # Compensation begins anew: it may know less of the motion before a view, or more.
    assert sum(compared) >= 0.8 * len(compared)


def test_frames_that_were_lost_cannot_be_read(tmp_path: Path) -> None:
    recording = record(tmp_path / "room.dat", Sensor(80, 56, 20_000.0), 0.1)
    last = recording.capture_index(recording.frames - 1)
    after = recording.captured(GAP_FIRST + GAP_FRAMES, 2)
    assert after is not None
    np.testing.assert_array_equal(after, recording.read(GAP_FIRST, 2))
    assert recording.captured(0, GAP_FIRST) is not None
    for first, count in ((GAP_FIRST - 1, 2), (GAP_FIRST + 5, 1), (GAP_FIRST + GAP_FRAMES - 1, 3), (-1, 2), (last, 2)):
        assert recording.captured(first, count) is None
