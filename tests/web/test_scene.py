"""The Scene page: what is on the canvas is what the service would render, and stays while versions come and go."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browsing import (
    PHONE,
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
from spiked_service.results.shown_scene import ShownScene

from spiked.scene import Scene

MANY = 500_000
STATES = ("boot", "track", "degraded", "lost", "reloc")


def open_scene(visit: Callable[..., Any], address: str, **more: Any) -> Any:
    page = visit(address, **more)
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    return page


def contrast(page: Any) -> float:
    return float(picture(page).std())


def test_the_scene_grows_while_the_camera_moves(
    daemon: Callable[..., Any], visit: Callable[..., Any], room: Path
) -> None:
    one = daemon("--device", "sim:", "--no-capture")
    plan = {"source": f"replay:{room}", "options": {"steps": 400}}
    capture_id = one.http.post("captures", json=plan).json()["id"]
    page = visit(f"{one.address}?page=scene&capture={capture_id}")
    until(lambda: shown_version(page) > 0, "the first version is on the canvas")
    until(lambda: (picture(page).min(axis=2) > 0.2).mean() > 0.05, "splats are to be seen, not only lines")
    # A sample of what is on the canvas at every frame drawn from here on: a flash would be a nearly empty picture.
    page.evaluate(
        """() => {
            const canvas = document.querySelector('.stage canvas');
            const small = new OffscreenCanvas(40, 25).getContext('2d', { willReadFrequently: true });
            window.lit = [];
            const look = () => {
                small.drawImage(canvas, 0, 0, 40, 25);
                const data = small.getImageData(0, 0, 40, 25).data;
                let lit = 0;
                for (let i = 0; i < data.length; i += 4) lit += Math.min(data[i], data[i + 1], data[i + 2]) > 50;
                window.lit.push(lit);
                requestAnimationFrame(look);
            };
            look();
        }"""
    )
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url) if "/scene/changes" in request.url else None)
    first, before = shown_version(page), picture(page)
    view = page.evaluate("() => location.search")
    until(lambda: shown_version(page) >= first + 2, "two newer versions")
    until(lambda: np.abs(picture(page) - before).mean() > 1e-4, "the picture has changed")
    assert asked and all("since=" in url for url in asked), "a version was fetched whole"
    lit = page.evaluate("() => window.lit")
    assert len(lit) > 3
    assert min(lit) > 0.4 * np.median(lit), "the canvas went dark between two versions"
    assert page.evaluate("() => location.search") == view, "a new version moved the camera"


def test_the_canvas_shows_what_the_service_renders(studied: Studied, visit: Callable[..., Any]) -> None:
    page = open_scene(visit, f"{studied.address}?page=scene&ride=1&frame=320")
    choose(page, "Rendered")
    size = page.evaluate("() => { const c = document.querySelector('.stage canvas'); return [c.width, c.height]; }")
    frame = int(page.get_by_label("Frame", exact=True).input_value())
    body = {"camera": {"frame": frame}, "width": size[0], "height": size[1]}
    answer = studied.http.post(
        f"reconstructions/{studied.reconstruction_id}/views", json=body, params={"format": "png"}
    )
    assert answer.status_code == 200, answer.text
    served = decoded(answer.content)
    until(lambda: psnr_db(picture(page), served) > 30, f"30 dB, not {psnr_db(picture(page), served):.1f}", 20)


@pytest.mark.slow
def test_each_layer_is_drawn_and_the_frustum_moves(studied: Studied, visit: Callable[..., Any]) -> None:
    page = open_scene(visit, f"{studied.address}?page=scene&frame=200")
    before = still(page)

    def changed() -> bool:
        return bool(np.abs(picture(page) - before).max() > 0.1)

    page.get_by_role("checkbox", name="Splats").uncheck()
    until(changed, "the splats are gone")
    for layer in ("Path", "Frustum", "Grid", "Axes"):
        before = still(page)
        box = page.get_by_role("checkbox", name=layer)
        box.uncheck()
        until(changed, f"{layer} is gone")
        box.check()
        until(lambda: not changed(), f"{layer} is back")
    choose(page, "Speed")
    until(changed, "the path has other colours")
    page.get_by_role("checkbox", name="Path").uncheck()
    before = still(page)
    page.get_by_label("Frame", exact=True).fill("900")
    until(changed, "the frustum is elsewhere")


@pytest.mark.slow
def test_states_are_told_without_colours(studied: Studied, visit: Callable[..., Any], pictures_folder: Path) -> None:
    """By dashes and widths, on the path and on the timeline, and as text."""
    trajectory = studied.http.get(f"reconstructions/{studied.reconstruction_id}/trajectory?format=json").json()
    path = np.float64(trajectory["positions"]) * [1, -1, -1]  # as three.js has its axes
    middle, size = (path.max(0) + path.min(0)) / 2, float(np.ptp(path, axis=0).max())
    camera = ",".join(f"{x:.5f}" for x in [*(middle + np.float64([0.3, 0.3, 1.1]) * size), *middle, 55])
    page = visit("about:blank")
    stretches: list[str] = []

    def retold(route: Any) -> None:
        answer = route.fetch()
        told = answer.json()
        for name in {"state", "states"} & set(told):
            rows = len(told[name])
            told[name] = [stretches[len(stretches) * row // rows] for row in range(rows)]
        route.fulfill(response=answer, json=told)

    page.route(re.compile(r"/(trajectory|timeline)\?"), retold)

    def pieces(*states: str) -> int:
        """How many the path on the canvas falls into, in shades of grey."""
        stretches[:] = states
        page.goto(f"{studied.address}?page=scene&frame=500&camera={camera}")
        until(lambda: shown_version(page) > 0, "a scene is on the canvas")
        for layer in ("Splats", "Frustum", "Grid", "Axes"):
            page.get_by_role("checkbox", name=layer).uncheck()
        until(lambda: picture(page).mean(axis=2).max() > 0.3, "the path is drawn")
        lit: int = cv2.connectedComponents((still(page).mean(axis=2) > 0.2).astype(np.uint8))[0] - 1
        return lit

    whole = pieces("track")
    assert pieces("boot") > 3 * whole
    pieces(*STATES)
    page.get_by_role("checkbox", name="Splats").check()
    still(page)
    keep(page, pictures_folder / "scene-states.webp")
    lit = picture(page, ".track canvas").max(axis=2) > 0.3
    styles = {}
    for state, part in zip(STATES, np.array_split(lit, len(STATES), axis=1), strict=True):
        inner = part[:, 8:-8]
        styles[state] = (int(inner.any(1).sum()), float(inner.any(0).mean()))
    for one, (height_px, share) in styles.items():
        alike = [
            name for name, style in styles.items() if abs(style[0] - height_px) < 1 and abs(style[1] - share) < 0.15
        ]
        assert alike == [one], styles
    slider = page.get_by_label("Frame", exact=True)
    most = int(slider.get_attribute("max"))
    for i, state in enumerate(STATES):
        slider.fill(str(round(most * (i + 0.5) / len(STATES))))
        page.locator(".scrubber output").filter(has_text=state).wait_for()
        assert (slider.get_attribute("aria-valuetext") or "").endswith(state)
    page.locator(".track canvas").hover()
    assert (page.locator(".track canvas").get_attribute("title") or "").startswith("degraded: ")


@pytest.mark.slow
def test_a_quarter_of_the_splats_looks_like_all(studied: Studied, visit: Callable[..., Any]) -> None:
    whole = open_scene(visit, f"{studied.address}?page=scene&ride=1&frame=320")
    choose(whole, "Rendered")
    page = visit("about:blank")
    # The page is told of a scene too large to be shown at once: a sixteenth of it first, then a quarter.
    page.route(
        re.compile(r"/reconstructions\?|/reconstructions/[^/]+$"),
        lambda route: route.fulfill(
            response=(answer := route.fetch()),
            body=re.sub(r'"splats":\s*\d+', '"splats": 999999', answer.text()),
        ),
    )
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url) if "/scene/changes" in request.url else None)
    page.goto(f"{studied.address}?page=scene&ride=1&frame=320")
    button = page.get_by_role("button", name="Show all")
    button.wait_for()
    choose(page, "Rendered")
    until(lambda: psnr_db(picture(page), picture(whole)) > 18, "a quarter looks like the whole", 20)
    assert [url.split("level=")[1][0] for url in asked] == ["0", "1"]
    button.click()
    button.wait_for(state="detached")
    until(lambda: psnr_db(picture(page), picture(whole)) > 50, "all of it is the whole", 20)


@pytest.mark.slow
def test_scrubbing_moves_the_camera_and_is_kept_in_the_url(studied: Studied, visit: Callable[..., Any]) -> None:
    page = open_scene(visit, f"{studied.address}?page=scene&ride=1")
    slider = page.get_by_label("Frame", exact=True)
    until(lambda: int(slider.get_attribute("max") or 0) > 500, "the path is there")
    choose(page, "Rendered")
    slider.fill("100")
    early = picture(page)
    slider.fill("500")
    until(lambda: np.abs(picture(page) - early).mean() > 0.01, "another view")
    assert "frame=500" in address(page)
    slider.press("ArrowRight")
    until(lambda: "frame=501" in address(page), "a frame on")
    page.reload()
    until(lambda: shown_version(page) > 0, "the scene is back")
    assert until(lambda: slider.input_value() == "501", "the same frame")
    page.get_by_role("button", name="End").click()
    until(lambda: "frame" not in address(page), "it follows the newest")
    page.get_by_role("button", name="Play").click()
    until(lambda: "frame" in address(page), "it plays")
    page.get_by_role("button", name="Pause").click()


def shown_frames(page: Any) -> tuple[int, int]:
    """The part of the time that the timeline shows."""
    first, last = (page.locator(".track > canvas").get_attribute(f"data-{end}") for end in ("first", "last"))
    return int(first), int(last)


@pytest.mark.slow
def test_the_timeline_zooms_by_wheel_keys_buttons_and_fingers(studied: Studied, visit: Callable[..., Any]) -> None:
    page = open_scene(visit, f"{studied.address}?page=scene&frame=600")
    strip = page.locator(".track > canvas")
    until(lambda: shown_frames(page)[1] > 900, "the path is there")
    whole = shown_frames(page)
    box = strip.bounding_box()
    quarter = box["x"] + box["width"] / 4, box["y"] + box["height"] / 2
    page.mouse.move(*quarter)
    with page.expect_request(re.compile(r"/timeline\?points=\d+&from_s=")):  # the part is asked for by itself
        page.mouse.wheel(0, -250)
    until(lambda: shown_frames(page) != whole, "the wheel zooms")
    first, last = shown_frames(page)
    length = (whole[1] - whole[0]) / np.e
    assert last - first == pytest.approx(length, abs=3)
    assert first + length / 4 == pytest.approx(whole[0] + (whole[1] - whole[0]) / 4, abs=5), "about the pointer"
    page.mouse.down()
    page.mouse.move(quarter[0] - box["width"] / 4, quarter[1], steps=5)
    page.mouse.up()
    until(lambda: shown_frames(page)[0] == pytest.approx(first + length / 4, abs=5), "a drag moves it")
    assert "frame=600" in address(page)
    page.mouse.click(*quarter)
    wanted = shown_frames(page)[0] + length / 4
    until(lambda: f"frame={wanted:.0f}"[:8] in address(page), "a click goes to a frame")
    slider = page.get_by_label("Frame", exact=True)
    slider.press("0")
    until(lambda: shown_frames(page) == whole, "0 shows everything")
    assert page.locator(".overview canvas").count() == 0
    slider.press("+")
    until(lambda: shown_frames(page) != whole, "+ zooms")
    page.get_by_role("status").filter(has_text="The timeline shows").wait_for(state="attached")
    assert page.locator(".overview canvas").count() == 1 and violations(page) == []
    page.get_by_role("button", name="Zoom out").click()
    until(lambda: shown_frames(page) == whole, "and out again")
    page.get_by_role("button", name="Zoom in").click()
    page.get_by_role("button", name="Whole time").click()
    until(lambda: shown_frames(page) == whole, "the whole again")
    phone = open_scene(visit, f"{studied.address}?page=scene&frame=600", viewport=PHONE, touch=True)
    until(lambda: shown_frames(phone)[1] > 900, "the path is there")
    assert phone.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    box = phone.locator(".track > canvas").bounding_box()
    fingers = phone.context.new_cdp_session(phone)
    y = box["y"] + box["height"] / 2
    for kind, ends in (
        ("touchStart", (0.4,)),
        ("touchStart", (0.4, 0.6)),
        ("touchMove", (0.25, 0.75)),
        ("touchMove", (0.1, 0.9)),
    ):
        points = [{"x": box["x"] + end * box["width"], "y": y, "id": 1 + i} for i, end in enumerate(ends)]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    until(lambda: shown_frames(phone)[1] - shown_frames(phone)[0] < (whole[1] - whole[0]) / 2.5, "two fingers zoom")


@pytest.mark.slow
def test_a_loop_is_drawn_and_told_when_it_closes(
    studied: Studied, visit: Callable[..., Any], pictures_folder: Path
) -> None:
    closed = [{"earlier_s": 0.004, "later_s": 0.03}]

    def retold(route: Any) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, json=answer.json() | {"closures": closed})

    page = visit("about:blank")
    page.route(re.compile(r"/timeline\?"), retold)
    page.goto(f"{studied.address}?page=scene&frame=500")
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    page.get_by_role("button", name="30.0").wait_for()
    before, strip = still(page), picture(page, ".track > canvas")
    closed.append({"earlier_s": 0.008, "later_s": 0.045})
    choice = page.get_by_role("combobox", name="Version")
    choice.select_option(index=1)  # another version: the timeline is asked for again
    said = page.get_by_role("status").filter(has_text="Loop closed")
    said.wait_for()
    assert "sees again what it saw at 8.0" in said.inner_text()
    choice.select_option("")
    until(lambda: np.abs(picture(page, ".track > canvas") - strip).max() > 0.3, "it is marked on the timeline")
    until(lambda: np.abs(picture(page) - before).max() > 0.3, "an arc is drawn")
    keep(page, pictures_folder / "scene-loop.webp")
    page.get_by_role("button", name="45.0").click()
    until(lambda: "frame=900" in address(page), "it leads to the moment")
    assert violations(page) == []
    drawn = still(page)
    page.get_by_role("checkbox", name="Closed loops").uncheck()
    until(lambda: np.abs(picture(page) - drawn).max() > 0.1, "the layer is gone")


@pytest.mark.slow
def test_riding_along_compares_observed_and_rendered(studied: Studied, visit: Callable[..., Any]) -> None:
    page = open_scene(visit, f"{studied.address}?page=scene&frame=320")
    page.get_by_role("button", name="Ride along").click()
    observed = page.locator("img.observed")
    observed.wait_for()
    stage = page.locator(".stage")
    box = stage.bounding_box()
    assert abs(box["width"] / box["height"] - 320 / 200) < 0.02

    def shown() -> Any:
        return decoded(stage.screenshot())[40:-80]  # without the names above and the buttons below

    choose(page, "Rendered")
    rendered = shown()
    choose(page, "Observed")
    until(lambda: 15 < psnr_db(shown(), rendered) < 60, "the camera has seen what is rendered", 20)
    seen = shown()
    choose(page, "Wipe")
    page.locator("input.wipe").fill("0.25")
    wiped = shown()
    quarter = wiped.shape[1] // 4
    assert psnr_db(wiped[:, : quarter - 4], seen[:, : quarter - 4]) > 40
    assert psnr_db(wiped[:, quarter + 4 :], rendered[:, quarter + 4 :]) > 40
    choose(page, "Difference")
    page.wait_for_timeout(100)
    difference = shown()
    assert psnr_db(difference, np.clip(4 * np.abs(seen - rendered), 0, 1)) > 30


@pytest.mark.slow
def test_views_are_bookmarked_and_linked(studied: Studied, visit: Callable[..., Any], pictures_folder: Path) -> None:
    page = open_scene(visit, f"{studied.address}?page=scene")
    canvas = page.locator(".stage canvas")
    at_first = still(page)
    page.get_by_role("button", name="Add").click()
    box = canvas.bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 300)
    page.mouse.down()
    page.mouse.move(box["x"] + 420, box["y"] + 330, steps=4)
    page.mouse.up()
    until(lambda: "camera=" in address(page), "the view is in the URL")
    until(lambda: np.abs(picture(page) - at_first).mean() > 0.005, "the view has turned")
    turned = still(page)
    elsewhere = open_scene(visit, address(page))
    until(lambda: psnr_db(picture(elsewhere), turned) > 30, "the link shows the same view", 20)
    page.get_by_role("button", name="View 1", exact=True).click()
    until(lambda: psnr_db(picture(page), at_first) > 30, "the bookmark brings the first view back", 20)
    with page.expect_download() as download:
        page.get_by_role("button", name="Screenshot").click()
    assert decoded(Path(download.value.path()).read_bytes()).shape == at_first.shape
    size = page.get_by_label("Size of the screenshot")
    size.select_option(label="other size")
    page.get_by_label("Width").fill("900")
    page.get_by_label("Height").fill("300")
    with page.expect_download() as download:
        page.get_by_role("button", name="Screenshot").click()
    wide = decoded(Path(download.value.path()).read_bytes())
    assert wide.shape == (300, 900, 3) and np.ptp(wide) > 0.4
    until(lambda: psnr_db(picture(page), at_first) > 30, "the canvas is as before", 20)

    page.get_by_role("button", name="Add").click()
    until(lambda: page.get_by_role("button", name="View 2", exact=True).count() == 1, "a second bookmark")
    keep(page, pictures_folder / "bookmarks.webp")


@pytest.mark.slow
def test_keys_fly_through_the_scene_only_while_it_has_the_focus(studied: Studied, visit: Callable[..., Any]) -> None:
    page = open_scene(visit, f"{studied.address}?page=scene")
    choose(page, "Fly")
    page.keyboard.press("w")
    page.wait_for_timeout(300)
    assert "camera=" not in address(page)
    page.locator(".stage canvas").focus()
    page.keyboard.down("w")
    until(lambda: "camera=" in address(page), "it flies")
    page.keyboard.up("w")


@pytest.mark.slow
def test_half_a_million_splats(studied: Studied, visit: Callable[..., Any]) -> None:
    random = np.random.default_rng(5)
    scene = Scene(
        random.normal(0, 1, (MANY, 3)).astype(np.float32) + np.float32([0, 0, 4]),
        np.tile(np.float32([1, 0, 0, 0]), (MANY, 1)),
        np.full((MANY, 3), np.log(0.01), np.float32),
        np.full(MANY, 2.0, np.float32),
        random.uniform(0, 1, (MANY, 1)).astype(np.float32),
    )
    content = ShownScene.of(scene, 1.0, 1).since(None).write()
    page = visit("about:blank")
    page.route(re.compile(r"/scene/changes"), lambda route: route.fulfill(body=content))
    page.goto(f"{studied.address}?page=scene")
    canvas = page.locator(".stage canvas")
    until(lambda: canvas.count() and canvas.get_attribute("data-splats") == str(MANY), "all of them are on the canvas")
    until(lambda: contrast(page) > 0.03, "they are to be seen")


def test_an_earlier_version_is_chosen(studied: Studied, visit: Callable[..., Any]) -> None:
    versions = studied.http.get(f"reconstructions/{studied.reconstruction_id}/versions").json()["items"]
    first, last = versions[0], versions[-1]
    assert first["version"] < last["version"]
    page = open_scene(visit, f"{studied.address}?page=scene&capture={studied.capture_id}&frame=200")
    assert shown_version(page) == last["version"]
    choice = page.get_by_role("combobox", name="Version")
    until(lambda: choice.locator("option").count() == len(versions), "all versions are listed")
    choice.select_option(str(first["version"]))
    until(lambda: shown_version(page) == first["version"], "the first version is on the canvas")
    assert f"version={first['version']}" in address(page)
    poses = page.locator(".inspector dl.stats div:has(dt:text-is('Poses')) dd")
    until(lambda: int(re.sub(r"\D", "", poses.inner_text())) == first["poses"], "the figures are those of the version")
    page.reload()
    until(lambda: shown_version(page) == first["version"], "the address holds the version")
    choice.select_option("")
    until(lambda: shown_version(page) == last["version"], "the newest is back")
    assert "version=" not in address(page)


def test_the_ride_along_an_earlier_version_shows_the_picture_by_its_optics(
    studied: Studied, visit: Callable[..., Any]
) -> None:
    first = studied.http.get(f"reconstructions/{studied.reconstruction_id}/versions").json()["items"][0]["version"]
    pinned = f"optics_of={studied.reconstruction_id}&optics_version={first}"
    page = visit("about:blank")
    with page.expect_request(lambda request: request.url.endswith(pinned)):
        page.goto(f"{studied.address}?page=scene&capture={studied.capture_id}&version={first}&ride=1&frame=200")
    until(lambda: shown_version(page) == first, "the first version is on the canvas")
    with page.expect_request(lambda request: request.url.endswith(f"optics_of={studied.reconstruction_id}")):
        page.get_by_role("combobox", name="Version").select_option("")


def test_the_scene_on_a_phone(studied: Studied, visit: Callable[..., Any]) -> None:
    page = open_scene(visit, f"{studied.address}?page=scene", viewport=PHONE, touch=True)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    box = page.locator(".stage canvas").bounding_box()
    assert box["width"] == PHONE["width"]
    page.get_by_role("button", name="Ride along").tap()
    page.locator("img.observed").wait_for()


def test_many_visits_leave_no_contexts_behind(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit("about:blank")
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.add_init_script(
        """
        window.contexts = [];
        const { getContext } = HTMLCanvasElement.prototype;
        HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
            const context = getContext.call(this, kind, ...more);
            if (kind.startsWith('webgl') && !window.contexts.includes(context)) window.contexts.push(context);
            return context;
        };
        """
    )
    page.goto(f"{studied.address}?page=scene&capture={studied.capture_id}")
    for _ in range(20):
        until(lambda: shown_version(page) > 0, "a scene is on the canvas")
        page.keyboard.press("1")
        page.locator("h1").filter(has_text="Live").wait_for(state="attached")
        page.keyboard.press("2")
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    open_now = "() => window.contexts.filter((one) => !one.isContextLost()).length"
    until(lambda: page.evaluate(open_now) == 1, "one context is left")
    assert page.evaluate("() => window.contexts.length") > 20
    assert not [text for text in said if "Too many active WebGL contexts" in text or "CONTEXT_LOST" in text]


def test_without_webgl_the_page_says_so(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit("about:blank")
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(f"{studied.address}?page=scene")
    page.get_by_text("This browser has no WebGL 2").wait_for()
    assert json.loads(studied.http.get("system").text)["pid"]
