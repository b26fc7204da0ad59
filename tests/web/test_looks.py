"""Every page in both themes and on a phone: reachable by keyboard, clean for axe, and a screenshot of each."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import AXE, DESKTOP, NODE_MODULES, PHONE, Studied, keep, picture, shown_version, still, until, violations

PAGES = {
    "live": "",
    "scene": "?page=scene",
    "ride": "?page=scene&ride=1&frame=320",
    "captures": "?page=captures",
    "capture": "?page=captures&capture={capture_id}",
    "setup": "?page=setup",
}
NOBODY = "00000000-0000-7000-8000-000000000000"


def settled(page: Any, name: str) -> None:
    """Wait until there is on the page what makes it that page."""
    if name in ("scene", "ride"):
        until(lambda: shown_version(page) > 0, "a scene")
        until(lambda: drawn(page) > 0.1, "the scene on the canvas")
        still(page)
    if name == "ride":
        page.locator("img.observed").wait_for()
    if name == "live":
        page.locator(".picture img").wait_for()
        until(lambda: page.locator(".histogram rect").count(), "a histogram")
    if name == "captures":
        page.locator(".list tbody tr").first.wait_for()
    if name == "capture":
        page.locator("figure.plot").nth(4).wait_for()
    if name == "setup":
        page.locator(".configuration tbody tr").first.wait_for()
        page.locator(".doctor li").first.wait_for()


def drawn(page: Any) -> float:
    """The share of the canvas that is not as its corner: lines alone take up little."""
    seen = picture(page)
    return float((np.abs(seen - seen[2, 2]).max(-1) > 0.1).mean())


def test_axe_is_there() -> None:
    """All tests that look for what people cannot use need it: without it they would find nothing wrong."""
    if not NODE_MODULES.is_dir():
        pytest.skip("no packages of Node are installed (make page)")
    assert AXE.is_file(), "axe-core is not installed: run npm ci in web"


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("name", PAGES)
def test_each_page(studied: Studied, visit: Callable[..., Any], pictures_folder: Path, name: str, theme: str) -> None:
    page = visit(studied.address + PAGES[name].format(capture_id=studied.capture_id), theme=theme)
    settled(page, name)
    keep(page, pictures_folder / f"{name}-{theme}.webp")
    assert page.evaluate("() => document.documentElement.scrollWidth") <= DESKTOP["width"]
    assert violations(page) == []


@pytest.mark.parametrize("name", ["live", *(pytest.param(name, marks=pytest.mark.slow) for name in list(PAGES)[1:])])
def test_each_page_on_a_phone(studied: Studied, visit: Callable[..., Any], pictures_folder: Path, name: str) -> None:
    page = visit(studied.address + PAGES[name].format(capture_id=studied.capture_id), viewport=PHONE, touch=True)
    settled(page, name)
    keep(page, pictures_folder / f"{name}-phone.webp")
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    assert violations(page) == []


def test_a_first_visit_and_a_service_that_is_gone(
    daemon: Callable[..., Any], visit: Callable[..., Any], pictures_folder: Path
) -> None:
    """What is empty, missing or disconnected says so and what to do."""
    one = daemon("--device", "sim:", "--no-capture")
    said = {
        "live": ("", "No capture yet"),
        "scene": ("?page=scene", "No scene yet"),
        "captures": ("?page=captures", "No captures yet"),
        "capture-missing": (f"?page=captures&capture={NOBODY}", "Try again"),
        "scene-missing": (f"?page=scene&capture={NOBODY}", "Newest scene"),
    }
    for name, (query, words) in said.items():
        page = visit(one.address + query)
        page.get_by_text(words).first.wait_for()
        keep(page, pictures_folder / f"{name}-empty.webp")
        assert violations(page) == []
    page = visit(one.address)
    page.get_by_text("connected", exact=True).wait_for()
    one.process.kill()
    page.get_by_text("The data below may be out of date").wait_for()
    keep(page, pictures_folder / "live-disconnected.webp")
    assert violations(page) == []
    page.goto("about:blank")


def test_the_theme_is_chosen_and_remembered(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(studied.address, theme="dark")
    paper = "() => getComputedStyle(document.documentElement).backgroundColor"
    dark = page.evaluate(paper)
    page.get_by_role("button", name="Theme: system").click()
    page.get_by_role("button", name="Theme: dark").click()
    light = page.evaluate(paper)
    assert light != dark
    page.reload()
    page.get_by_role("button", name="Theme: light").wait_for()
    assert page.evaluate(paper) == light


def test_everything_is_reached_by_keyboard(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(studied.address)
    page.locator(".live").wait_for()
    page.keyboard.press("Tab")
    assert page.evaluate("() => document.activeElement.textContent") == "Skip to content"
    reached = []
    for _ in range(30):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("() => document.activeElement.textContent.trim() || document.activeElement.type"))
    tabs = ["Live", "Scene", "Captures", "Set-up"]
    assert [name for name in dict.fromkeys(reached) if name in tabs] == tabs
    assert "Start" in reached
    page.evaluate("() => document.activeElement.blur()")
    page.keyboard.press("3")
    page.get_by_role("heading", name="Captures").wait_for()
    page.go_back()
    page.locator(".live").wait_for()


@pytest.mark.slow
def test_nothing_is_fetched_from_elsewhere(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit("about:blank")
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    for name, query in PAGES.items():
        page.goto(studied.address + query.format(capture_id=studied.capture_id))
        settled(page, name)
    assert len(asked) > 20
    assert [url for url in asked if not url.startswith((studied.address, "blob:", "data:"))] == []
