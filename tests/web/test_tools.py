"""Tools of the Scene page: what the splats show, from where, and help."""

import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import DESKTOP, PHONE, Studied, address, keep, picture, shown_version, still, until, violations


@pytest.fixture
def scene(studied: Studied, visit: Callable[..., Any]) -> Callable[..., Any]:
    """Opens the scene of the studied capture, and waits until it is drawn."""

    def open_scene(query: str = "", **more: Any) -> Any:
        page = visit(f"{studied.address}?page=scene&capture={studied.capture_id}{query}", **more)
        until(lambda: shown_version(page) > 0, "a scene is on the canvas")
        still(page)
        return page

    return open_scene


def unlike(page: Any, before: Any) -> bool:
    """Whether the canvas shows something else than before."""
    now = picture(page)
    return now.shape != before.shape or bool(np.abs(now - before).mean() > 2e-3)


def test_each_view_mode_shows_something_else(scene: Callable[..., Any]) -> None:
    page = scene()
    colour = last = still(page)
    modes = page.get_by_label("Show", exact=True)
    for mode in ("Depth", "Normals", "Opacity", "Number of splats", "Points"):
        modes.select_option(label=mode)
        until(lambda: unlike(page, colour) and unlike(page, last), f"{mode} looks otherwise")  # noqa: B023
        last = picture(page)
    assert "show=points" in address(page)
    modes.select_option(label="Error against the views")
    page.get_by_text("observed − rendered").wait_for()
    assert violations(page) == []
    modes.select_option(label="Colour")
    until(lambda: not unlike(page, colour), "the colours are back")


def test_the_view_is_changed_by_presets_keys_and_a_double_click(scene: Callable[..., Any]) -> None:
    page = scene()
    before = still(page)
    page.get_by_role("button", name="Top", exact=True).click()
    until(lambda: unlike(page, before), "another view")
    page.locator(".stage canvas").focus()
    page.keyboard.press("h")
    until(lambda: not unlike(page, before), "home")
    page.get_by_role("slider", name="Field of view").fill("90")
    until(lambda: ",90" in address(page), "the field of view is in the address")
    page.keyboard.press("Shift+Tab")
    target = address(page)
    box = page.locator(".stage canvas").bounding_box()
    page.mouse.dblclick(box["x"] + 0.4 * box["width"], box["y"] + 0.5 * box["height"])
    until(lambda: address(page) != target, "the view turns to the point")
    page.locator(".stage canvas").focus()
    page.keyboard.press("m")
    until(lambda: "show=depth" in address(page), "the next mode")


def test_fingers_turn_move_and_zoom_the_scene(scene: Callable[..., Any]) -> None:
    page = scene("&camera=0,0,1,0,0,-1,55", viewport=PHONE, touch=True)
    box = page.locator(".stage canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    views = [address(page)]
    fingers = page.context.new_cdp_session(page)

    def touched(kind: str, *points: tuple[float, float]) -> None:
        places = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})

    def changed() -> bool:
        views.append(address(page))
        return views[-1] != views[-2]

    touched("touchStart", (x, y))
    touched("touchMove", (x + 60, y + 10))
    touched("touchEnd")
    until(changed, "one finger turns it")
    touched("touchStart", (x - 40, y), (x + 40, y))
    touched("touchMove", (x - 80, y), (x + 80, y))
    touched("touchEnd")
    until(changed, "two fingers zoom")
    page.wait_for_timeout(500)

    def tapped_twice() -> bool:
        for _ in range(2):
            page.touchscreen.tap(x + 20, y + 15)
        return changed()

    # On a busy machine the second tap may come too late to be one of a pair.
    until(tapped_twice, "a double tap turns to the point", pause_s=0.5)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]


def test_a_slow_machine_draws_fewer_pixels_while_the_view_moves(scene: Callable[..., Any]) -> None:
    page = scene()
    width = "() => document.querySelector('.stage canvas').width"
    full = page.evaluate(width)
    box = page.locator(".stage canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.evaluate(
        f"() => {{ window.widths = new Set(); const look = () => {{ window.widths.add(({width})());"
        " requestAnimationFrame(look); }; look(); }"
    )
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 50, y, steps=10)
    page.mouse.up()
    until(lambda: page.evaluate(width) == full, "all pixels at rest")
    assert min(page.evaluate("() => [...window.widths]")) == full // 2


def test_points_are_drawn_without_graphics_hardware(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit("about:blank")
    page.add_init_script("if (!window.name) localStorage.removeItem('spiked.splats'); window.name = 'again';")
    page.goto(f"{studied.address}?page=scene&capture={studied.capture_id}")
    page.locator(".stage-notes").get_by_text("without graphics hardware").wait_for()
    assert page.get_by_label("Show", exact=True).input_value() == "points"
    assert violations(page) == []
    points = still(page)
    page.get_by_role("button", name="Draw splats").click()
    until(lambda: unlike(page, points), "splats")
    assert page.get_by_label("Show", exact=True).input_value() == "colour"
    page.reload()
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    assert page.locator(".stage-notes").get_by_text("without graphics hardware").count() == 0


def test_the_key_m_leads_from_points_to_splats_without_graphics_hardware(
    studied: Studied, visit: Callable[..., Any]
) -> None:
    page = visit("about:blank")
    page.add_init_script("localStorage.removeItem('spiked.splats')")
    page.goto(f"{studied.address}?page=scene&capture={studied.capture_id}")
    page.locator(".stage-notes").get_by_text("without graphics hardware").wait_for()
    modes = page.get_by_label("Show", exact=True)
    page.locator(".stage canvas").focus()
    for mode in ("colour", "depth"):
        page.keyboard.press("m")
        until(lambda: modes.input_value() == mode, f"{mode} is shown")  # noqa: B023


def test_nothing_is_claimed_before_splats_are_drawn(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit("about:blank")
    page.add_init_script(
        """
        const { postMessage } = Worker.prototype;
        window.held = [];
        Worker.prototype.postMessage = function (...all) {
            if (JSON.stringify(all[0]?.name ?? '').includes('sort') && window.held !== null)
                window.held.push(() => postMessage.apply(this, all));
            else postMessage.apply(this, all);
        };
        """
    )
    page.goto(f"{studied.address}?page=scene&capture={studied.capture_id}")
    page.get_by_text("Sorting the splats…").wait_for()
    canvas = page.locator(".stage canvas")
    assert canvas.get_attribute("data-splats") == "0" and "nothing drawn yet" in (
        canvas.get_attribute("aria-label") or ""
    )
    assert page.locator(".inspector dl.stats dd").first.inner_text() == "–"
    page.evaluate("() => { const held = window.held; window.held = null; held.forEach((send) => send()); }")
    until(lambda: shown_version(page) > 0, "the splats are drawn")
    assert np.ptp(picture(page)) > 0.4


HEADSET = """
Object.defineProperty(navigator, 'xr', { value: {
    isSessionSupported: (mode) => Promise.resolve(mode === 'immersive-vr'),
    requestSession: (mode) => { window.asked = mode; return Promise.reject(new Error('The headset is asleep.')); },
    addEventListener() {}, removeEventListener() {},
} });
"""


@pytest.mark.parametrize("viewport", [DESKTOP, PHONE])
def test_a_headset_is_offered_where_there_is_one(
    studied: Studied, scene: Callable[..., Any], visit: Callable[..., Any], viewport: dict[str, int]
) -> None:
    assert scene().get_by_role("button", name="Enter VR").count() == 0
    page = visit("about:blank", viewport=viewport)
    page.add_init_script(HEADSET)
    page.goto(f"{studied.address}?page=scene&capture={studied.capture_id}")
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    before = still(page)
    page.get_by_role("button", name="Enter VR").click()
    page.get_by_text("The headset is asleep.").wait_for()
    assert page.evaluate("() => window.asked") == "immersive-vr"
    until(lambda: not unlike(page, before), "the page shows the scene as before")


def test_help_is_one_key_away(scene: Callable[..., Any]) -> None:
    page = scene(viewport=PHONE)
    page.get_by_role("button", name="Keys and help").click()
    page.get_by_role("dialog").get_by_text("It says degraded").wait_for()
    assert violations(page) == []
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    page.keyboard.press("Escape")
    page.get_by_role("dialog").wait_for(state="hidden")
    page.keyboard.press("?")
    page.get_by_role("dialog").wait_for()


def test_a_known_length_gives_metres(studied: Studied, scene: Callable[..., Any]) -> None:
    url = f"reconstructions/{studied.reconstruction_id}/scale"
    studied.http.delete(url)
    page = scene()
    page.get_by_text("Measure", exact=True).click()
    page.get_by_text("The scale is not known").wait_for()
    box = page.locator(".stage canvas").bounding_box()
    measured = page.locator(".measured")
    for across in (0.45, 0.62):
        page.mouse.click(box["x"] + across * box["width"], box["y"] + 0.45 * box["height"])
    until(lambda: "units" in measured.inner_text(), "a length in the scene's unit")
    units = float(measured.inner_text().split()[0])
    page.get_by_label("Known length in metres").fill("3")
    page.get_by_role("button", name="Set the scale").click()
    until(lambda: measured.inner_text().startswith("3.000 m ±"), "the length is 3 m")
    stored = studied.http.get(url).json()
    assert stored["metres_per_unit"] == pytest.approx(3 / units, rel=1e-3)
    assert 0 < stored["sigma"] < 0.02
    page.get_by_role("radio", name="Up").check()
    page.locator(".stage canvas").focus()
    for key in ("ArrowLeft", "ArrowUp", "ArrowRight"):
        for _ in range(4):
            page.keyboard.press(key)
        page.keyboard.press("Enter")
    page.get_by_role("button", name="This is the floor").click()
    page.get_by_text("Up is known").wait_for()
    assert studied.http.get(url).json()["up"] is not None
    assert violations(page) == []
    studied.http.delete(url)


def test_a_version_of_an_earlier_run_takes_no_scale(studied: Studied, scene: Callable[..., Any]) -> None:
    items = studied.http.get(f"reconstructions/{studied.reconstruction_id}/versions").json()["items"]
    first, last = items[0]["version"], items[-1]["version"]
    (folder,) = Path(studied.http.get("system").json()["data_folder"]).glob(f"**/{studied.reconstruction_id}")
    (folder / "scale.json").write_text(json.dumps({"revision": 7, "since": first, "metres_per_unit": 2.0}))
    page = scene(f"&version={first}")
    page.get_by_text("Measure", exact=True).click()
    page.get_by_text("of an earlier run").wait_for()
    assert page.get_by_text("A unit is").count() == 0
    page.get_by_role("combobox", name="Version").select_option("")
    until(lambda: shown_version(page) == last, "the newest version")
    page.get_by_text("A unit is 2").wait_for()
    with page.expect_request(re.compile(r"/scale$")) as sent:
        box = page.locator(".stage canvas").bounding_box()
        for across in (0.45, 0.62):
            page.mouse.click(box["x"] + across * box["width"], box["y"] + 0.45 * box["height"])
        page.get_by_label("Known length in metres").fill("3")
        page.get_by_role("button", name="Set the scale").click()
    assert sent.value.post_data_json["version"] == last
    assert violations(page) == []
    (folder / "scale.json").unlink()


def test_the_ride_has_the_optics_of_the_version(studied: Studied, scene: Callable[..., Any]) -> None:
    page = scene("&ride=1&how=rendered&frame=320")
    own = still(page)

    def retold(route: Any) -> None:
        answer = route.fetch()
        items = answer.json()["items"]
        for one in items:
            one["intrinsics"] |= {"fx": one["intrinsics"]["fx"] / 2, "fy": one["intrinsics"]["fy"] / 2}
        route.fulfill(response=answer, json={"items": items})

    page.route(re.compile(r"/versions$"), retold)
    page.reload()
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    until(lambda: unlike(page, own), "twice the field of view")
    middle = own[::2, ::2]
    wide = still(page)
    height, width = middle.shape[:2]
    top, left = (wide.shape[0] - height) // 2, (wide.shape[1] - width) // 2
    found = wide[top : top + height, left : left + width]
    assert np.abs(found - middle).mean() < 0.5 * np.abs(wide - own).mean(), "what was all is now the middle"


def test_a_scene_is_cleaned_and_brought_back(studied: Studied, scene: Callable[..., Any]) -> None:
    page = scene()
    before = studied.reconstruction()
    page.locator("summary").filter(has_text="Clean").click()
    page.get_by_role("slider", name="far").focus()
    page.keyboard.press("PageUp")
    cut = page.get_by_role("button", name="Cut to the box")
    cut.click()
    page.get_by_text("splats outside of the box").wait_for()
    until(lambda: studied.reconstruction()["splats"] < before["splats"], "fewer splats")
    until(lambda: shown_version(page) > before["version"], "the cut scene is shown")
    page.get_by_role("button", name="Undo").click()
    until(lambda: studied.reconstruction()["splats"] == before["splats"], "all splats are back")
    page.get_by_role("button", name="Remove floaters").click()
    page.get_by_text(re.compile(r"Removed \d.* floaters")).wait_for()
    assert violations(page) == []
    cleaned = studied.reconstruction()
    until(lambda: shown_version(page) == cleaned["version"], "the cleaned scene is shown")
    page.get_by_role("slider", name="far").focus()
    page.keyboard.press("PageUp")
    cut.click()
    until(lambda: studied.reconstruction()["splats"] < cleaned["splats"], "fewer splats still")
    for splats in (cleaned["splats"], before["splats"]):
        page.get_by_role("button", name="Undo").click()
        until(lambda splats=splats: studied.reconstruction()["splats"] == splats, "each change is undone")
    until(page.get_by_role("button", name="Undo").is_disabled, "nothing is left to undo")


def test_a_cleaning_is_undone_after_the_page_was_left(studied: Studied, scene: Callable[..., Any]) -> None:
    before = studied.reconstruction()
    url = f"reconstructions/{studied.reconstruction_id}"
    box = {"low": [-1e6, -1e6, -1e6], "high": [0.0, 1e6, 1e6]}
    for high in (0.0, -0.2):
        box["high"][0] = high
        version = studied.reconstruction()["version"]
        answer = studied.http.post(f"{url}:clean", json={"version": version, "floaters": False, "box": box})
        assert answer.status_code == 200, answer.text
    page = scene()
    for _ in range(2):
        page.locator("summary").filter(has_text="Clean").click()
        version = studied.reconstruction()["version"]
        page.get_by_role("button", name="Undo").click()
        until(lambda version=version: studied.reconstruction()["version"] > version, "undone")
        page.reload()
        until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    assert studied.reconstruction()["splats"] == before["splats"]
    page.locator("summary").filter(has_text="Clean").click()
    until(page.get_by_role("button", name="Undo").is_disabled, "nothing is left to undo")
    assert violations(page) == []


def test_the_box_stays_in_sight_on_a_phone(scene: Callable[..., Any], pictures_folder: Path) -> None:
    page = scene(viewport=PHONE, touch=True)
    page.locator("summary").filter(has_text="Clean").tap()
    slider = page.get_by_role("slider", name="far")
    slider.scroll_into_view_if_needed()
    page.evaluate("() => document.scrollingElement.scrollBy(0, 150)")
    canvas, field = page.locator(".stage canvas").bounding_box(), slider.bounding_box()
    bar = page.locator(".bar").bounding_box()
    assert canvas["y"] >= bar["y"] + bar["height"] - 1 and canvas["height"] > 250, "the whole scene is in sight"
    assert canvas["y"] + canvas["height"] <= field["y"] < PHONE["height"], "above the sliders"
    before = still(page)
    slider.fill("40")
    until(lambda: unlike(page, before), "the box is drawn")
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    assert violations(page) == []
    keep(page, pictures_folder / "crop-phone.webp")


@pytest.mark.parametrize(("viewport", "touch"), [(DESKTOP, False), (PHONE, True)])
def test_the_end_of_the_panel_is_reached_while_there_is_a_message(
    scene: Callable[..., Any], viewport: dict[str, int], touch: bool
) -> None:
    page = scene(viewport=viewport, touch=touch)
    shot = page.get_by_role("button", name="Screenshot", exact=True)
    with page.expect_download():
        shot.click()
    message = page.locator(".toast")
    message.wait_for()
    page.evaluate(
        "() => { for (const one of [document.querySelector('.inspector'), document.scrollingElement])"
        " one.scrollTo(0, one.scrollHeight); }"
    )
    end, top = shot.bounding_box(), message.bounding_box()["y"]
    assert end["y"] + end["height"] <= top, "it is above the message"


def test_the_version_that_is_shown_is_downloaded(studied: Studied, scene: Callable[..., Any]) -> None:
    before = studied.reconstruction()
    url = f"reconstructions/{studied.reconstruction_id}"
    cut = {"version": before["version"], "floaters": False, "box": {"low": [-1e6] * 3, "high": [0.0, 1e6, 1e6]}}
    cleaned = studied.http.post(f"{url}:clean", json=cut).json()
    page = scene()

    def fetched(name: str, version: int) -> bytes:
        with page.expect_download() as download:
            link = page.get_by_role("group", name=f"Download version {version}").get_by_role("link", name=name)
            link.focus()
            page.keyboard.press("Enter")
        assert download.value.suggested_filename == f"scene-{version:06d}.{name.lower()}"
        return Path(download.value.path()).read_bytes()

    ply = fetched("PLY", cleaned["version"])
    assert f"element vertex {cleaned['splats']}\n".encode() in ply[:2000]
    spz = fetched("SPZ", cleaned["version"])
    assert spz == studied.http.get(f"{url}/scene?format=spz&version={cleaned['version']}").content
    page.get_by_role("combobox", name="Version").select_option(str(before["version"]))
    until(lambda: shown_version(page) == before["version"], "an earlier version")
    assert f"element vertex {before['splats']}\n".encode() in fetched("PLY", before["version"])[:2000]
    assert violations(page) == []
    back = {"version": cleaned["version"], "to": before["version"]}
    assert studied.http.post(f"{url}:revert", json=back).status_code == 200


def focused(page: Any) -> str:
    """What has the keyboard's focus: its text, or the label of a field."""
    found: str = page.evaluate(
        "() => { const at = document.activeElement; return at.labels?.length && at.tagName !== 'BUTTON'"
        " ? at.labels[0].textContent : at.tagName === 'BODY' ? 'nothing' : at.textContent; }"
    )
    return found


def test_cleaning_by_keyboard_leaves_the_focus_where_it_is(studied: Studied, scene: Callable[..., Any]) -> None:
    page = scene()
    before = studied.reconstruction()
    page.locator("summary").filter(has_text="Clean").focus()
    page.keyboard.press("Enter")
    slider = page.get_by_role("slider", name="far")
    slider.focus()
    page.keyboard.press("PageUp")
    page.keyboard.press("Tab")
    assert focused(page) == "Cut to the box"
    page.keyboard.press("Enter")
    until(lambda: studied.reconstruction()["splats"] < before["splats"], "fewer splats")
    until(lambda: page.get_by_role("button", name="Undo").is_enabled(), "it can be undone")
    assert focused(page) == "Cut to the box", "although nothing is left to cut"
    cut = studied.reconstruction()["version"]
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")
    assert focused(page) == "Undo"
    page.keyboard.press("Enter")
    until(lambda: studied.reconstruction()["splats"] == before["splats"], "all splats are back")
    until(page.get_by_role("button", name="Undo").is_disabled, "nothing is left to undo")
    assert focused(page) == "Undo" and studied.reconstruction()["version"] == cut + 1
    assert violations(page) == []


def test_splats_inside_a_lasso_are_removed(studied: Studied, scene: Callable[..., Any], pictures_folder: Path) -> None:
    page = scene()
    before = studied.reconstruction()
    page.locator("summary").filter(has_text="Clean").click()
    page.get_by_role("button", name="Draw around splats").click()
    box = page.locator(".stage canvas").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(middle[0] + 90, middle[1])
    page.mouse.down()
    for turn in np.linspace(0, 2 * np.pi, 24):
        page.mouse.move(middle[0] + 90 * np.cos(turn), middle[1] + 60 * np.sin(turn))
    page.mouse.up()
    remove = page.get_by_role("button", name=re.compile(r"Remove \d.* splats"))
    remove.wait_for()
    assert violations(page) == []
    keep(page, pictures_folder / "lasso.webp")
    inside = int(re.sub(r"\D", "", remove.inner_text()))
    remove.click()
    page.get_by_text(re.compile(r"Removed \d.* splats")).wait_for()
    until(lambda: studied.reconstruction()["splats"] == before["splats"] - inside, "as many as the page has counted")
    until(lambda: focused(page) == "Stop drawing", "the pressed button has gone")
    page.keyboard.press("Escape")
    page.get_by_role("button", name="Draw around splats").wait_for()
    page.get_by_role("button", name="Undo").click()
    until(lambda: studied.reconstruction()["splats"] == before["splats"], "all splats are back")


def test_many_captures_are_kept_and_deleted_at_once(studied: Studied, visit: Callable[..., Any]) -> None:
    ids = []
    for name in ("first of two", "second of two"):
        plan = {"source": "sim:?width=64&height=48", "frames": 64, "name": name, "reconstruct": False}
        capture_id = studied.http.post("captures", json=plan).json()["id"]
        until(lambda: studied.http.get(f"captures/{capture_id}").json()["state"] == "complete", name)  # noqa: B023
        ids.append(capture_id)
    page = visit(f"{studied.address}?page=captures&search=of%20two")
    for name in ("first of two", "second of two"):
        page.get_by_role("checkbox", name=f"Select {name}").check()
    page.get_by_text("2 selected").wait_for()
    assert violations(page) == []
    page.get_by_role("button", name="Keep", exact=True).click()
    until(lambda: all(studied.http.get(f"captures/{one}").json()["keep"] for one in ids), "both are kept")
    page.get_by_label("Order").select_option(label="by name")
    page.get_by_label("Filter").select_option(label="kept")
    rows = page.locator("table.list tbody tr")
    until(lambda: rows.count() == 2 and "first" in rows.first.inner_text(), "sorted by name")
    for name in ("first of two", "second of two"):
        page.get_by_role("checkbox", name=f"Select {name}").check()
    page.get_by_role("group", name="Selected captures").get_by_role("button", name="Delete").click()
    until(lambda: all(studied.http.get(f"captures/{one}").json()["deleted_at"] for one in ids), "both are deleted")


def test_the_results_of_selected_captures_are_downloaded(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=captures&search=desk")
    page.get_by_role("checkbox", name="Select desk, loose cable").check()
    bar = page.get_by_role("group", name="Selected captures")
    assert bar.get_by_role("button", name="Results").is_disabled(), "it was not reconstructed"
    page.get_by_role("checkbox", name="Select desk, by hand").check()
    with page.expect_download() as download:
        bar.get_by_role("button", name="Results").click()
    with zipfile.ZipFile(download.value.path()) as bundle:
        assert any(name.endswith("scene.ply") for name in bundle.namelist())
