"""Cameras on the Set-up page: their profile is edited, and their pixels are calibrated."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from browsing import until, violations
from spiked_service.settings.tokens import Scope, Tokens

from spiked.sensor import Sensor
from tests.still_recordings import pixels, place, still

SENSOR = Sensor(96, 64, 20_000.0)


def cameras(page: Any) -> Any:
    """The panel."""
    return page.locator(".panel:has(h2:text-is('Cameras'))")


def test_the_profile_of_a_camera_is_edited(daemon: Callable[..., Any], visit: Callable[..., Any]) -> None:
    one = daemon("--device", "sim:", "--no-capture")
    page = visit(f"{one.address}?page=setup")
    panel = cameras(page)
    panel.get_by_text("Nothing is stated of this camera.").wait_for()
    panel.locator("summary", has_text="Profile").click()
    panel.get_by_label("mosaic").select_option("GRBG")
    panel.get_by_label("intrinsics").fill("200,200,100,nonsense")
    panel.get_by_role("button", name="Save").click()
    page.get_by_text('"nonsense" is not a number').wait_for()
    panel.get_by_label("intrinsics").fill("200,200,100,60,-0.2")
    panel.get_by_label("serial").fill("A7")
    panel.get_by_role("button", name="Save").click()
    panel.get_by_text("Captures of this camera take what is stated here.").wait_for()
    stored = one.http.get("devices/sim%3A/profile").json()["profile"]
    assert (stored["mosaic"], stored["serial"]) == ("GRBG", "A7")
    assert stored["intrinsics"]["distortion"]["k1"] == -0.2
    until(lambda: panel.get_by_label("intrinsics").input_value() == "200,200,100,60,-0.2,0,0,0,0", "it is shown again")
    panel.get_by_role("button", name="Remove the profile").click()
    panel.get_by_text("Nothing is stated of this camera.").wait_for()
    assert one.http.get("devices/sim%3A/profile").status_code == 404


def test_settings_are_changed_and_what_restarts_is_told(
    daemon: Callable[..., Any], visit: Callable[..., Any], tmp_path: Path, pictures_folder: Path
) -> None:
    file = tmp_path / "spiked.toml"
    file.write_text("# ours\nretention_days = 90\n")
    one = daemon("--config", str(file), "--set", "limit_captures=2", "--no-capture")
    page = visit(f"{one.address}?page=setup")
    panel = page.locator(".panel:has(h2:text-is('Configuration'))")
    panel.locator("summary", has_text="Change settings").click()
    panel.get_by_text("Given at the start or by the environment, and changed there: limit_captures").wait_for()
    panel.get_by_label(re.compile("^retention days")).fill("30")
    panel.get_by_label(re.compile("^limit renders")).fill("3")
    field = panel.get_by_role("spinbutton", name="retention bytes", exact=True)  # named without its hint
    field.fill("20000000000")
    field.locator("xpath=..").get_by_text(
        re.compile(r"20\.0\sGB\. Remove the oldest.+ Takes effect at once\.")
    ).wait_for()
    field.fill("")
    panel.get_by_label(re.compile("^log format")).select_option("json")
    assert violations(page) == []
    panel.screenshot(path=pictures_folder / "settings.png")
    panel.get_by_role("button", name="Save").click()
    page.get_by_text("In effect: limit_renders, retention_days; after a restart: log_format").wait_for()
    panel.get_by_text("After a restart of the service: log_format").wait_for()
    assert file.read_text() == '# ours\nretention_days = 30\nlog_format = "json"\nlimit_renders = 3\n'
    panel.get_by_label(re.compile("^retention days")).fill("40000")
    field = panel.get_by_label(re.compile("^retention days"))
    panel.get_by_role("button", name="Save").click()
    assert field.evaluate("field => !field.checkValidity()"), "the browser refuses it"
    panel.get_by_label(re.compile("^retention days")).fill("")
    panel.get_by_role("button", name="Save").click()
    until(lambda: "retention_days" not in file.read_text(), "captures are kept for ever")


def test_tokens_are_made_and_revoked(
    daemon: Callable[..., Any], visit: Callable[..., Any], tmp_path: Path, pictures_folder: Path
) -> None:
    tokens = Tokens(tmp_path / "data")
    mine = tokens.create("mine")
    one = daemon("--set", "require_token=true", "--no-capture", token=mine)
    page = visit(f"{one.address}?token={mine}&page=setup")
    panel = page.locator(".panel:has(h2:text-is('Tokens'))")
    panel.locator("summary", has_text="Create a token").click()
    panel.get_by_label("Name").fill("display")
    panel.get_by_label("Scope").select_option("operate")
    panel.get_by_role("button", name="Create").click()
    made = panel.locator(".made")
    made.wait_for()
    secret = made.locator("code").last.inner_text()
    holder = tokens.holder_of(secret)
    assert holder is not None and (holder.name, holder.scope) == ("display", Scope.OPERATE)
    assert violations(page) == []
    panel.screenshot(path=pictures_folder / "tokens.png")
    made.get_by_role("button", name="Hide").click()
    assert secret not in page.content()
    panel.get_by_role("button", name="Revoke display").click()
    panel.get_by_role("button", name="Revoke at once").click()
    panel.get_by_role("row").filter(has_text="display").wait_for(state="detached")
    assert tokens.holder_of(secret) is None


def test_a_token_is_entered_where_none_is_required(
    daemon: Callable[..., Any], visit: Callable[..., Any], tmp_path: Path
) -> None:
    tokens = Tokens(tmp_path / "data")
    one = daemon("--no-capture")
    page = visit(f"{one.address}?page=setup")
    panel = page.locator(".panel:has(h2:text-is('Tokens'))")
    panel.get_by_text("tokens limit nothing until").wait_for()
    panel.locator("summary", has_text="Create or revoke a token").click()
    panel.get_by_label("Token", exact=True).fill("guess")
    panel.get_by_role("button", name="Sign in").click()
    panel.get_by_text("This token is not valid.").wait_for()
    assert violations(page) == []
    panel.get_by_label("Token", exact=True).fill(tokens.create("mine"))
    panel.get_by_role("button", name="Sign in").click()
    panel.locator("summary", has_text="Create a token").click()
    panel.get_by_label("Name", exact=True).fill("display")
    panel.get_by_role("button", name="Create").click()
    made = panel.locator(".made")
    made.get_by_text("Authorization: Bearer").wait_for()
    panel.get_by_role("button", name="Revoke display").click()
    panel.get_by_role("button", name="Revoke at once").click()
    made.wait_for(state="detached")  # it opens nothing any more
    assert [one.name for one in Tokens(tmp_path / "data").all()] == ["mine"]


def test_a_person_calibrates_a_camera(
    daemon: Callable[..., Any], visit: Callable[..., Any], tmp_path: Path, pictures_folder: Path
) -> None:
    for name, light in (("dark", 0.0), ("wall", 0.2)):
        still(tmp_path / f"{name}.dat", SENSOR, light)
    shown = tmp_path / "camera.dat"
    place(shown, tmp_path / "wall.dat")
    one = daemon("--device", f"replay:{shown}", "--no-capture")
    page = visit(f"{one.address}?page=setup")
    panel = cameras(page)
    dark, light = (panel.get_by_role("button", name=name) for name in ("Record the dark", "Record the light"))
    measure = panel.get_by_role("button", name="Measure")
    assert measure.is_disabled()
    place(shown, tmp_path / "dark.dat")
    dark.click()
    panel.get_by_text("recorded", exact=True).wait_for()
    place(shown, tmp_path / "wall.dat")
    light.click()
    until(lambda: panel.get_by_text("recorded", exact=True).count() == 2, "both are recorded")
    measure.click()
    useless = int(((pixels(SENSOR).gain == 0) | (pixels(SENSOR).dark > 0.1)).sum())
    panel.get_by_text(f"{useless} of {SENSOR.width * SENSOR.height} pixels are dead or hot").wait_for()
    pictures = panel.locator("figure img")
    until(
        lambda: pictures.evaluate_all(
            f"all => all.length == 3 && all.every(one => one.naturalWidth == {SENSOR.width})"
        ),
        "the pictures are loaded",
    )
    page.screenshot(path=pictures_folder / "calibration.png", full_page=True)
    # Somebody who forgets the cover is told, and nothing is changed.
    before = one.http.get(
        f"devices/{one.http.get('devices').json()['items'][0]['id'].replace('/', '%2F')}/profile"
    ).json()
    dark.click()
    panel.get_by_text("recorded", exact=True).wait_for()
    measure.click()
    panel.get_by_text("is not dark").wait_for()
    assert (
        before
        == one.http.get(
            f"devices/{one.http.get('devices').json()['items'][0]['id'].replace('/', '%2F')}/profile"
        ).json()
    )
