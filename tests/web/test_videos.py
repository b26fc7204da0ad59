"""Videos and exports from the page: what is chosen is made, and what cannot be made is told."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import pytest
from browsing import DESKTOP, PHONE, Studied, finished, keep, shown_version, until, violations

LONGEST_ENTRY = """field => {
    const { paddingLeft, paddingRight, font } = getComputedStyle(field);
    const pen = document.createElement('canvas').getContext('2d');
    pen.font = font;
    const longest = Math.max(...[...field.options].map(one => pen.measureText(one.text).width));
    const arrow = 20;
    return longest + arrow + parseFloat(paddingLeft) + parseFloat(paddingRight) - field.clientWidth;
}"""
"""By how many pixels the longest entry of a choice is too long for it; its arrow is up to 20 px wide."""


def made(page: Any) -> tuple[int, int, int, float]:
    """Width, height and number of the pictures of the video that is downloaded, and how many a second."""
    with page.expect_download() as download:
        page.get_by_role("link", name="Video, ").click()
    with av.open(str(download.value.path())) as file:
        shapes = [(frame.width, frame.height) for frame in file.decode(video=0)]
        return *shapes[0], len(shapes), float(file.streams.video[0].average_rate or 0)


@pytest.mark.parametrize(("viewport", "touch"), [(DESKTOP, False), (PHONE, True)])
def test_videos_are_made_as_chosen(
    studied: Studied, visit: Callable[..., Any], pictures_folder: Path, viewport: dict[str, int], touch: bool
) -> None:
    page = visit(f"{studied.address}?page=scene&capture={studied.capture_id}", viewport=viewport, touch=touch)
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    page.locator("summary").filter(has_text="Video").click()
    assert page.get_by_label("Video of").evaluate(LONGEST_ENTRY) < 0, "each entry is shown whole"
    page.get_by_label("Width", exact=True).fill("160")
    page.get_by_label("Height", exact=True).fill("120")
    page.get_by_label("Pictures a second").fill("10")
    page.get_by_label("Times slower").fill("20")
    of = page.get_by_label("Video of")
    for kind in ("the scene, smoothed path", "the scene, recorded path"):
        of.select_option(label=kind)
        with page.expect_request(re.compile("exports/video")) as asked:
            width, height, pictures, fps = made(page)
        assert (width, height, fps) == (160, 120, 10.0) and 8 <= pictures <= 11, "51 ms, 20 times slower"
        assert ("along=recorded" in asked.value.url) == ("recorded" in kind)
    of.select_option(label="the recording, slow motion")
    page.get_by_label("Frames of a picture").fill("8")
    assert made(page) == (320, 200, 10, 10.0)
    of.select_option(label="the scene, through bookmarks")
    page.get_by_text("Save two or more bookmarks").wait_for()
    for preset in ("Left", "Right"):
        page.get_by_role("button", name=preset, exact=True).click()
        page.get_by_role("button", name="Add", exact=True).click()
    page.get_by_label("Seconds from each to the next").fill("0.5")
    assert made(page) == (160, 120, 5, 10.0)
    page.get_by_label("Seconds from each to the next").fill("0.01")
    page.get_by_text("show it more slowly").wait_for()
    assert violations(page) == []
    assert page.evaluate("() => document.documentElement.scrollWidth") <= viewport["width"]
    panel = page.locator("details.tool").filter(has_text="Video").bounding_box()
    for field in page.locator(".tool select, .tool input[type=number]").all():
        box = field.bounding_box()
        assert box["x"] + box["width"] <= panel["x"] + panel["width"] + 1, "it ends where the panel ends"
    keep(page, pictures_folder / f"video-{viewport['width']}.webp")


@pytest.mark.parametrize(("viewport", "touch"), [(DESKTOP, False), (PHONE, True)])
def test_a_recording_without_a_reconstruction_is_shown_in_slow_motion(
    studied: Studied, visit: Callable[..., Any], pictures_folder: Path, viewport: dict[str, int], touch: bool
) -> None:
    plan = {"source": "sim:?width=64&height=48", "frames": 640, "name": "no scene", "reconstruct": False}
    one = studied.http.post("captures", json=plan).json()["id"]
    finished(studied.http, one)
    try:
        page = visit(f"{studied.address}?page=captures&capture={one}", viewport=viewport, touch=touch)
        page.locator("summary").filter(has_text="Video in slow motion").click()
        page.get_by_label("Pictures a second").fill("10")
        page.get_by_label("Times slower").fill("50")
        page.get_by_label("Frames of a picture").fill("8")
        with page.expect_request(re.compile("recording/video")) as asked:
            assert made(page) == (64, 48, 16, 10.0), "32 ms, 50 times slower"
        assert one in asked.value.url
        page.get_by_label("Times slower").fill("0.001")
        page.get_by_text("show it more slowly").wait_for()
        assert violations(page) == []
        assert page.evaluate("() => document.documentElement.scrollWidth") <= viewport["width"]
        keep(page, pictures_folder / f"slow-motion-{viewport['width']}.webp")
    finally:
        studied.http.delete(f"captures/{one}")


def test_a_video_that_cannot_be_made_is_told(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=scene&capture={studied.capture_id}")
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    page.locator("summary").filter(has_text="Video").click()
    page.get_by_label("Video of").select_option(label="the recording, slow motion")
    page.get_by_label("Times slower").fill("0.001")
    page.get_by_text("show it more slowly").wait_for()
    page.get_by_label("Times slower").fill("20")
    page.get_by_label("Frames of a picture").fill("5000")
    page.get_by_role("link", name="Video, ").click()
    page.locator(".toast.problem").filter(has_text=re.compile("4096|4,096")).wait_for()
    assert page.get_by_role("link", name="Video, ").is_visible(), "the page is still there"


def test_an_export_that_cannot_be_made_is_told(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=captures&capture={studied.capture_id}")
    page.get_by_text("For other programs").click()
    link = page.get_by_role("link", name="depth", exact=True)
    link.wait_for()
    detail = "another export is being made; try again when it is ready"
    page.route(
        re.compile("/exports/depth"), lambda route: route.fulfill(status=503, json={"title": "busy", "detail": detail})
    )
    link.click()
    page.get_by_text("Another export is being made").wait_for()
    page.unroute_all()
    with page.expect_download() as download:
        page.get_by_role("link", name="ply", exact=True).click()
    assert Path(download.value.path()).read_bytes().startswith(b"ply")
