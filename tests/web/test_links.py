"""Links to the Scene page: they show what was seen, also when there is something newer."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from browsing import DESKTOP, PHONE, Studied, address, choose, picture, psnr_db, shown_version, still, until, violations


def newer(studied: Studied, name: str) -> str:
    """Make a capture that is newer than the studied one; return its id."""
    plan = {"source": "sim:?width=64&height=48", "frames": 64, "name": name, "reconstruct": False}
    one: str = studied.http.post("captures", json=plan).json()["id"]
    until(lambda: studied.http.get(f"captures/{one}").json()["state"] == "complete", name)
    return one


@pytest.mark.parametrize(("viewport", "touch"), [(DESKTOP, False), (PHONE, True)])
def test_a_copied_link_shows_the_same_view_later(
    studied: Studied, visit: Callable[..., Any], viewport: dict[str, int], touch: bool
) -> None:
    page = visit(f"{studied.address}?page=scene", viewport=viewport, touch=touch)
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    before = still(page)
    page.get_by_role("button", name="Top", exact=True).click()
    until(lambda: "camera=" in address(page), "the view is in the address")
    page.get_by_role("checkbox", name="Grid").uncheck()
    page.get_by_role("radio", name="Speed").check()
    until(lambda: psnr_db(picture(page), before) < 30, "the new view is drawn")
    seen = still(page)
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.get_by_role("button", name="Copy link").click()
    page.get_by_text("Copied the link to this view").wait_for()
    assert violations(page) == []
    link = page.evaluate("() => navigator.clipboard.readText()")
    for part in (f"capture={studied.capture_id}", f"reconstruction={studied.reconstruction_id}", "version=", "camera="):
        assert part in link
    bar = address(page)
    assert f"capture={studied.capture_id}&reconstruction={studied.reconstruction_id}" in bar
    late = newer(studied, "newer than the link")
    try:
        for one in (link, bar):
            other = visit(one, viewport=viewport, touch=touch)
            until(lambda: shown_version(other) > 0, "the scene of the link")  # noqa: B023
            until(lambda: psnr_db(picture(other), seen) > 30, "the same view")  # noqa: B023
            assert not other.get_by_role("checkbox", name="Grid").is_checked()
            assert other.get_by_role("radio", name="Speed").is_checked()
        page.get_by_text("This capture has no reconstruction").wait_for()  # the page that follows shows the newest
        page.reload()
        page.get_by_text("This capture has no reconstruction").wait_for()
        page.keyboard.press("1")
        page.get_by_role("heading", name="Live").wait_for(state="attached")
        assert "capture=" not in address(page)
    finally:
        studied.http.delete(f"captures/{late}")


@pytest.mark.parametrize("known", [False, True], ids=["asked for", "known"])
def test_a_reconstruction_without_a_capture_brings_its_own(
    studied: Studied, visit: Callable[..., Any], known: bool
) -> None:
    late = newer(studied, "newer than the reconstruction")
    try:
        page = visit(f"{studied.address}?page=scene&reconstruction={studied.reconstruction_id}")
        if known:
            page.get_by_role("link", name="Live").click()
            page.go_back()
        until(lambda: shown_version(page) > 0, "the scene")
        name = studied.http.get(f"captures/{studied.capture_id}").json()["name"]
        assert page.locator(".inspector header strong").inner_text() == name
        until(lambda: f"capture={studied.capture_id}&reconstruction=" in address(page), "its capture is named")
        gone = "00000000-0000-7000-8000-000000000000"
        page.goto(f"{studied.address}?page=scene&reconstruction={gone}")
        page.get_by_role("button", name="Newest scene").wait_for()
    finally:
        studied.http.delete(f"captures/{late}")


def test_a_step_back_names_what_is_shown(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=scene")
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    named = f"capture={studied.capture_id}&reconstruction={studied.reconstruction_id}"
    until(lambda: named in address(page), "what is followed is in the address")
    # The entry of a page that follows the newest, from when that was another one.
    page.evaluate(
        "named => history.replaceState(history.state, '', "
        "location.search.replace(named, 'capture=x&reconstruction=a'))",
        named,
    )
    page.evaluate("named => history.pushState(null, '', `?page=scene&${named}`)", named)
    page.go_back()
    until(lambda: named in address(page), "what is shown is in the address")
    assert shown_version(page) > 0


def test_a_link_is_copied_without_a_secure_context(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit("about:blank")
    page.add_init_script("Object.defineProperty(navigator, 'clipboard', { value: undefined })")
    page.goto(f"{studied.address}?page=scene")
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    page.get_by_role("button", name="Copy link").click()
    page.get_by_text("Copied the link to this view").wait_for()
    page.evaluate(
        "() => { const a = document.createElement('textarea'); a.id = 'pasted'; document.body.append(a); a.focus(); }"
    )
    page.keyboard.press("Control+v")
    assert f"capture={studied.capture_id}" in page.locator("#pasted").input_value()


def test_the_error_against_the_views_is_in_the_address(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=scene&capture={studied.capture_id}&frame=320")
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    page.get_by_label("Show", exact=True).select_option(label="Error against the views")
    page.get_by_text("observed − rendered").wait_for()
    until(lambda: "how=difference" in address(page), "it is in the address")
    other = visit(address(page))
    other.get_by_text("observed − rendered").wait_for()
    assert other.get_by_label("Show", exact=True).input_value() == "error"
    choose(other, "Observed")
    until(lambda: "how=observed" in address(other), "so are the others")
    other.get_by_role("button", name="Ride along").click()
    until(lambda: "how=" not in address(other) and "ride=" not in address(other), "and gone with the ride")


def test_a_reconstruction_that_is_awaited_or_gone_is_told(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit("about:blank")
    held: list[Any] = []
    holding = True
    of_jobs = re.compile(r"/reconstructions(/[\w-]+)?(\?.*)?$")
    page.route(of_jobs, lambda route: held.append(route) if holding else route.continue_())
    page.goto(f"{studied.address}?page=scene&capture={studied.capture_id}&reconstruction={studied.reconstruction_id}")
    page.get_by_text("Loading the scene").wait_for()
    until(lambda: any(one.request.url.endswith(studied.reconstruction_id) for one in held), "it is asked for")
    assert page.get_by_role("button", name="Reconstruct it").count() == 0
    holding = False
    for one in held:
        one.continue_()
    until(lambda: shown_version(page) > 0, "a scene is on the canvas")
    gone = visit(f"{studied.address}?page=scene&capture={studied.capture_id}&reconstruction=gone")
    gone.get_by_role("alert").filter(has_text="It may have been deleted").wait_for()
    assert gone.get_by_role("button", name="Reconstruct it").count() == 0
    assert violations(gone) == []
    gone.get_by_role("button", name="Newest scene").click()
    until(lambda: shown_version(gone) > 0, "the newest scene is on the canvas")


def test_a_version_that_is_gone_is_told(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=scene&capture={studied.capture_id}&version=999")
    page.get_by_role("status").filter(has_text="Version 999 is not kept").wait_for()
    until(lambda: shown_version(page) == studied.reconstruction()["version"], "the newest is shown")
    page.get_by_role("combobox", name="Version").select_option(index=1)
    page.get_by_text("Version 999 is not kept").wait_for(state="detached")


def test_a_scene_that_cannot_be_fetched_is_asked_for_less_and_less_often(
    studied: Studied, visit: Callable[..., Any]
) -> None:
    page = visit("about:blank")
    asked: list[str] = []
    failing = True

    def answer(route: Any) -> None:
        asked.append(route.request.url)
        if failing:
            route.fulfill(status=503, json={"title": "busy", "detail": "the disk is slow"})
        else:
            route.continue_()

    page.route(re.compile(r"/scene/changes"), answer)
    page.goto(f"{studied.address}?page=scene&capture={studied.capture_id}")
    page.get_by_text("The disk is slow").wait_for()
    page.wait_for_timeout(5000)
    assert 2 < len(asked) < 9, "five a second would be 25"
    failing = False
    until(lambda: shown_version(page) > 0, "it is fetched when the service answers again", 20)
    assert np.ptp(picture(page)) > 0
