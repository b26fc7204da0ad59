"""Tokens: asked for where others can reach the service, shown on Set-up, and worthless once they are revoked."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from browsing import PATIENCE_S, address, finished, keep, until, violations


def token(data: Path, *words: str) -> str:
    """What `spiked token` prints."""
    command = [sys.executable, "-m", "spiked_service", "token", *words, "--data", str(data)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.strip()


def test_who_comes_from_elsewhere_signs_in(
    daemon: Callable[..., Any], visit: Callable[..., Any], tmp_path: Path, pictures_folder: Path
) -> None:
    data = tmp_path / "data"
    laptop, phone = token(data, "create", "laptop"), token(data, "create", "phone", "--days", "30")
    one = daemon("--host", "0.0.0.0", "--no-capture", "--device", "sim:", token=laptop)
    here = one.address.replace("0.0.0.0", "127.0.0.1")
    page = visit(f"{here}?page=setup")
    page.get_by_text("This service requires a token").wait_for()
    keep(page, pictures_folder / "sign-in.webp")
    assert violations(page) == []
    page.get_by_label("Token", exact=True).fill("guess")
    page.get_by_role("button", name="Sign in").click()
    page.get_by_text("This token is not valid").wait_for()
    page.get_by_label("Token", exact=True).fill(phone)
    page.get_by_role("button", name="Sign in").click()
    page.get_by_text("connected", exact=True).wait_for()
    assert address(page).endswith("?page=setup")  # where it was to go

    tokens = page.locator(".panel:has(h2:text-is('Tokens'))")
    tokens.get_by_role("row").filter(has_text="laptop").get_by_text("never").wait_for()
    tokens.get_by_role("row").filter(has_text="phone").wait_for()
    token(data, "create", "tablet")
    tokens.get_by_role("button", name="Refresh").click()
    tablet = tokens.get_by_role("row").filter(has_text="tablet")
    tablet.wait_for()
    token(data, "revoke", "tablet")
    tokens.get_by_role("button", name="Refresh").click()
    tablet.wait_for(state="detached")

    token(data, "revoke", "phone")
    page.get_by_text("This service requires a token").wait_for()  # by itself, when it next asks for anything
    keep(page, pictures_folder / "signed-out.webp")
    assert violations(page) == []
    assert page.locator(".banner").count() == 0
    page.get_by_label("Token", exact=True).fill(phone)
    page.get_by_role("button", name="Sign in").click()
    page.get_by_text("This token is not valid").wait_for()
    page.get_by_label("Token", exact=True).fill(laptop)
    page.get_by_role("button", name="Sign in").click()
    page.get_by_text("connected", exact=True).wait_for()
    tokens.get_by_role("row").filter(has_text="laptop").wait_for()
    assert tokens.get_by_role("row").filter(has_text="phone").count() == 0


def test_a_token_in_the_address_is_kept_out_of_sight(daemon: Callable[..., Any], visit: Callable[..., Any]) -> None:
    one = daemon("--token", "sesame-open-the-door", "--no-capture", token="sesame-open-the-door")
    page = visit(f"{one.address}?token=sesame-open-the-door")
    page.get_by_text("connected", exact=True).wait_for(timeout=1000 * PATIENCE_S)
    assert "token" not in address(page)


def test_a_token_that_only_reads_is_offered_nothing_else(
    daemon: Callable[..., Any], visit: Callable[..., Any], tmp_path: Path
) -> None:
    """What would be answered with 403 is hidden or disabled, and the page says why."""
    data = tmp_path / "data"
    admin, reader = token(data, "create", "keeper"), token(data, "create", "guest", "--scope", "read")
    one = daemon("--set", "require_token=true", "--no-capture", "--device", "sim:", token=admin)
    plan = {"source": "sim:?width=64&height=48", "frames": 64, "name": "desk", "reconstruct": False}
    capture_id = one.http.post("captures", json=plan).json()["id"]
    finished(one.http, capture_id)
    reason = "Your token has the scope read; this needs the scope operate."
    forbidden: list[str] = []
    page = visit("about:blank")
    page.on("response", lambda answer: forbidden.append(answer.url) if answer.status == 403 else None)

    page.goto(f"{one.address}?page=setup&token={reader}")
    administration = page.locator(".panel:has(h2:text-is('Administration'))")
    administration.get_by_text("Your token has the scope read; this needs the scope admin.").wait_for()
    page.locator(".doctor li").first.wait_for()
    assert page.get_by_role("heading", name="Configuration", exact=True).count() == 0
    assert page.get_by_role("heading", name="Tokens", exact=True).count() == 0
    assert violations(page) == []

    page.goto(one.address)
    start = page.get_by_role("button", name="Start")
    page.get_by_text(reason).wait_for()
    assert start.is_disabled() and start.get_attribute("title") == reason
    assert page.get_by_label("Device").is_disabled()

    page.goto(f"{one.address}?page=captures")
    page.get_by_role("button", name="Delete desk").wait_for()
    until(page.get_by_role("button", name="Delete desk").is_disabled, "nothing can be deleted")
    page.goto(f"{one.address}?page=captures&capture={capture_id}")
    page.get_by_text(reason).wait_for()
    for name in ("Reconstruct", "Delete"):
        assert page.get_by_role("button", name=name, exact=True).is_disabled()
    assert page.get_by_role("checkbox", name="Keep").is_disabled()
    for label in ("Name of the capture", "Notes on the capture"):
        assert not page.get_by_label(label).is_editable()
    assert violations(page) == []
    assert forbidden == []

    page.goto(f"{one.address}?page=setup&token={admin}")
    page.get_by_role("heading", name="Configuration", exact=True).wait_for()
    page.locator(".panel:has(h2:text-is('Tokens'))").get_by_role("row").filter(has_text="guest").wait_for()
    assert administration.count() == 0
