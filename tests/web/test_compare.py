"""Two scenes beside each other, with one camera."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import (
    DESKTOP,
    PHONE,
    STEPS,
    Picture,
    Studied,
    address,
    choose,
    decoded,
    keep,
    picture,
    psnr_db,
    shown_version,
    still,
    until,
    violations,
)

from spiked.evaluate import umeyama
from spiked.trajectory import Trajectory

SECOND = ".second canvas"


@pytest.fixture(scope="module")
def other_id(studied: Studied) -> Iterator[str]:
    """Another reconstruction of the studied capture, with half the steps; gone for the tests of other files."""
    plan = {"capture_id": studied.capture_id, "options": {"steps": STEPS // 2}}
    other: str = studied.http.post("reconstructions", json=plan).json()["id"]

    def ended() -> bool:
        state = studied.http.get(f"reconstructions/{other}").json()
        assert state["state"] in ("queued", "running", "complete"), state["reason"]
        return bool(state["state"] == "complete")

    until(ended, "another reconstruction", 300)
    yield other
    assert studied.http.delete(f"reconstructions/{other}").status_code == 204


@pytest.fixture
def compared(studied: Studied, other_id: str, visit: Callable[..., Any]) -> Callable[..., Any]:
    """Opens the studied scene beside another one, and waits until both are drawn."""

    def open_scenes(query: str = "", against: str = other_id, **more: Any) -> Any:
        page = visit(
            f"{studied.address}?page=scene&capture={studied.capture_id}&reconstruction={studied.reconstruction_id}"
            f"&against={against}{query}",
            **more,
        )
        for canvas in (".stage > canvas", SECOND):
            until(lambda: int(page.locator(canvas).get_attribute("data-version") or 0) > 0, canvas)  # noqa: B023
        still(page)
        return page

    return open_scenes


def stage(page: Any) -> Picture:
    """What is seen of the stage, all layers of it."""
    return decoded(page.locator(".stage").screenshot())


def halves(of: Picture) -> tuple[slice, slice]:
    """The columns left and right of the line of a wipe and its handle, when it is in the middle."""
    middle = of.shape[1] // 2
    return slice(0, middle - 16), slice(middle + 16, None)


def apart(a: Picture, b: Picture) -> float:
    """Mean difference of two pictures, infinite for two sizes."""
    return float(np.abs(a - b).mean()) if a.shape == b.shape else float("inf")


def rms_error(path: Trajectory, truth: Trajectory) -> float:
    """Root mean square distance of the centres after the best similarity, in units of the truth."""
    rows = truth.nearest(path.times_s, 1e-4)
    known = rows >= 0
    found, true = path.centres[known], truth.centres[rows[known]]
    away = umeyama(source=found, target=true).points(found) - true
    return float(np.sqrt((away**2).sum(1).mean()))


def drag(page: Any, canvas: str, by: int) -> None:
    """Drag from the middle of a canvas to the right."""
    box = page.locator(canvas).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + by, y, steps=5)
    page.mouse.up()


def test_two_reconstructions_are_chosen_and_turned_together(
    studied: Studied, other_id: str, visit: Callable[..., Any], pictures_folder: Path
) -> None:
    page = visit(
        f"{studied.address}?page=scene&reconstruction={studied.reconstruction_id}&capture={studied.capture_id}"
    )
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    still(page)
    page.locator("summary").filter(has_text="Compare").click()
    named = page.locator(f"option[value='{other_id}.']").inner_text()
    assert re.match(r"#2, \d\d:\d\d:\d\d: ", named), f"{named}: as the page of the capture calls it"
    page.get_by_label("With").select_option(value=f"{other_id}.")
    until(lambda: page.locator(SECOND).count() == 1, "a second canvas")
    until(lambda: int(page.locator(SECOND).get_attribute("data-version") or 0) > 0, "the second scene")
    page.get_by_text("The second is laid over the first by its poses").wait_for()
    still(page)
    first, second = picture(page), picture(page, SECOND)
    assert apart(first, second) < 0.08, "both show the same room from the same place"
    drag(page, ".stage > canvas", 80)
    until(lambda: apart(picture(page), first) > 0.01 and apart(picture(page, SECOND), second) > 0.01, "both turn")
    still(page)
    first, second = picture(page), picture(page, SECOND)
    drag(page, SECOND, -120)
    until(lambda: apart(picture(page), first) > 0.01 and apart(picture(page, SECOND), second) > 0.01, "both turn")
    still(page)
    assert apart(picture(page), picture(page, SECOND)) < 0.08
    assert f"against={other_id}" in address(page)
    assert violations(page) == []
    keep(page, pictures_folder / "compare-dark.webp")
    page.get_by_role("button", name="Stop comparing").click()
    until(lambda: page.locator(SECOND).count() == 0, "one scene")
    assert "against" not in address(page)
    assert page.get_by_label("With").evaluate("field => field === document.activeElement"), "the button has gone"


def test_a_long_choice_is_told_in_full(
    studied: Studied, other_id: str, compared: Callable[..., Any], pictures_folder: Path
) -> None:
    name = "with half of the steps and all of the splats that the walk along the corridor has left over"
    studied.http.patch(f"reconstructions/{other_id}", json={"name": name})
    page = compared(viewport=PHONE, touch=True)
    told = page.locator(".chosen")
    told.get_by_text(re.compile(rf"^With #2, {name}: \d+.*\d\sdB$")).wait_for()
    assert told.evaluate("text => text.scrollWidth <= text.clientWidth"), "it is broken into lines"
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    told.scroll_into_view_if_needed()
    assert violations(page) == []
    keep(page, pictures_folder / "compare-long.webp")
    studied.http.patch(f"reconstructions/{other_id}", json={"name": ""})


def test_the_divider_is_moved_by_mouse_and_keys(compared: Callable[..., Any], pictures_folder: Path) -> None:
    page = compared("&how=wipe")
    before = stage(page)
    rows, (left, right) = slice(before.shape[0] // 8, -before.shape[0] // 8), halves(before)
    assert psnr_db(before[rows, left], picture(page)[rows, left]) > 40, "the first on the left"
    assert psnr_db(before[rows, right], picture(page, SECOND)[rows, right]) > 40, "the second on the right"
    divider = page.get_by_role("slider", name="on the left")
    divider.focus()
    for _ in range(30):
        page.keyboard.press("ArrowRight")
    assert float(divider.input_value()) == pytest.approx(0.8)
    until(lambda: apart(stage(page), before) > 1e-3, "another part of the second")
    box = page.locator(".stage").bounding_box()
    y = box["y"] + 0.4 * box["height"]
    page.mouse.move(box["x"] + 0.8 * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.3 * box["width"], y, steps=5)
    page.mouse.up()
    assert float(divider.input_value()) == pytest.approx(0.3, abs=0.03)
    first = still(page)
    drag(page, ".stage > canvas", 60)
    until(lambda: apart(picture(page), first) > 0.01, "the scene beside the divider is turned")
    assert violations(page) == []
    page.locator(".sorting").wait_for(state="detached")
    still(page)
    keep(page, pictures_folder / "compare-wipe.webp")


def test_the_difference_of_a_scene_and_itself_is_black(
    studied: Studied, other_id: str, compared: Callable[..., Any], pictures_folder: Path
) -> None:
    page = compared("&how=difference", against=studied.reconstruction_id)
    box = page.locator(".stage").bounding_box()
    clip = {**box, "height": box["height"] - 60}  # the note is below

    def seen() -> float:
        return float(decoded(page.screenshot(clip=clip)).mean())

    until(lambda: seen() < 2e-3, "black")
    page = compared("&how=difference", against=other_id)
    until(lambda: seen() > 1e-2, "what differs")
    assert violations(page) == []
    keep(page, pictures_folder / "compare-difference.webp")


def test_paths_are_compared_with_the_truth(
    studied: Studied, other_id: str, room: Path, compared: Callable[..., Any], pictures_folder: Path
) -> None:
    page = compared()
    plain = still(page)
    choose(page, "Paths")
    until(lambda: apart(picture(page), plain) > 1e-3, "paths")
    truth = room.parent / "groundtruth.tum"
    page.get_by_label("True path").set_input_files(truth)
    row = page.locator("table.compared tr").filter(has_text="Path error")
    row.wait_for()
    shown = re.findall(r"([\d.]+) (mm|m)\b", row.inner_text())
    assert len(shown) == 2
    for one, (number, unit) in zip((studied.reconstruction_id, other_id), shown, strict=True):
        tum = studied.http.get(f"reconstructions/{one}/trajectory?format=tum").text
        path = truth.with_name(f"{one}.tum")
        path.write_text(tum)
        error_m = rms_error(Trajectory.read_tum(path), Trajectory.read_tum(truth))
        assert float(number) * (1e-3 if unit == "mm" else 1) == pytest.approx(error_m, rel=0.02)
    assert violations(page) == []
    keep(page, pictures_folder / "compare-paths.webp")
    page.get_by_label("True path").set_input_files(
        {"name": "odd.tum", "mimeType": "text/plain", "buffer": b"0.1 1 2\n"}
    )
    page.get_by_text("Line 1 is no pose").wait_for()


def test_scenes_are_compared_on_a_phone(compared: Callable[..., Any], pictures_folder: Path) -> None:
    page = compared(viewport=PHONE, touch=True, theme="light")
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    first, second = (page.locator(one).bounding_box() for one in (".stage > canvas", SECOND))
    assert min(first["width"], second["width"]) > 150 and min(first["height"], second["height"]) > 150
    assert violations(page) == []
    keep(page, pictures_folder / "compare-phone.webp")
    page.get_by_label("With").scroll_into_view_if_needed()
    keep(page, pictures_folder / "compare-phone-panel.webp")


def test_an_earlier_version_is_compared_and_brought_back(studied: Studied, compared: Callable[..., Any]) -> None:
    before = studied.reconstruction()
    url = f"reconstructions/{studied.reconstruction_id}"
    low, high = [-1e6, -1e6, -1e6], [0.0, 1e6, 1e6]
    cut = {"version": before["version"], "floaters": False, "box": {"low": low, "high": high}}
    after = studied.http.post(f"{url}:clean", json=cut).json()
    assert after["splats"] < before["splats"]
    page = compared(f"&against-version={before['version']}", against=studied.reconstruction_id)
    table = page.locator("table.compared")
    numbers = [
        int("".join(filter(str.isdigit, text)))
        for text in table.locator("tr", has_text="Splats").locator("td").all_inner_texts()
    ]
    assert numbers == [after["splats"], before["splats"]]
    page.get_by_role("button", name="Stop comparing").click()
    page.locator(".inspector .version select").select_option(value=str(before["version"]))
    page.get_by_role("button", name=f"Go back to version {before['version']}").click()
    until(lambda: studied.reconstruction()["splats"] == before["splats"], "all splats are back")
    page.get_by_text(f"The scene is as version {before['version']} was").wait_for()
    chooser = page.get_by_role("combobox", name="Version")
    assert chooser.evaluate("field => field === document.activeElement"), "the button has gone"
    assert violations(page) == []


def saved(page: Any) -> Picture:
    """The picture that Screenshot saves."""
    with page.expect_download() as download:
        page.get_by_role("button", name="Screenshot").click()
    return decoded(Path(download.value.path()).read_bytes())


def alike(file: Picture, seen: Picture) -> float:
    """Likeness of a saved picture and of what is seen, without the names above and the notes below.

    Of means of 8 by 8 pixels: the browser's own picture of a place that begins between two rows of pixels has both."""
    assert np.abs(np.subtract(file.shape, seen.shape)).max() <= 1
    high, wide = np.minimum(file.shape, seen.shape)[:2] // 8 * 8

    def means(one: Picture) -> Picture:
        return np.asarray(one[:high, :wide].reshape(high // 8, 8, wide // 8, 8, 3).mean((1, 3))[6:-8])

    return psnr_db(means(file), means(seen))


def test_a_screenshot_has_both_scenes(compared: Callable[..., Any]) -> None:
    page = compared()
    for how in ("Beside", "Wipe", "Difference"):
        choose(page, how)
        if how == "Wipe":
            page.get_by_role("slider", name="on the left").fill("0.3")
        still(page)
        seen, file = stage(page), saved(page)
        assert alike(file, seen) > 25, how
    choose(page, "Beside")
    size = page.get_by_label("Size of the screenshot")
    size.select_option(label="other size")
    page.get_by_label("Width", exact=True).fill("900")
    page.get_by_label("Height", exact=True).fill("300")
    wide = saved(page)
    assert wide.shape == (300, 900, 3)
    assert apart(wide[:, :448], wide[:, 452:]) < 0.08, "the same room twice"
    assert min(np.ptp(wide[:, :448]), np.ptp(wide[:, 452:])) > 0.4


@pytest.mark.parametrize("viewport", [DESKTOP, PHONE])
def test_a_screenshot_of_the_ride_has_the_picture_of_the_camera(
    studied: Studied, visit: Callable[..., Any], viewport: dict[str, int]
) -> None:
    page = visit(f"{studied.address}?page=scene&capture={studied.capture_id}&ride=1&frame=320", viewport=viewport)
    page.locator("img.observed").wait_for()
    for how in ("Wipe", "Difference", "Observed", "Rendered"):
        choose(page, how)
        if how == "Wipe":
            page.locator("input.wipe").fill("0.25")
        still(page)
        seen, file = stage(page), saved(page)
        assert alike(file, seen) > 25, how
    page.get_by_label("Size of the screenshot").select_option(label="1920 × 1080")
    assert saved(page).shape == (1200, 1920, 3), "the shape of the sensor"
