"""Tokens: asked for where others can reach the service, shown on Set-up, and worthless once they are revoked."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from browsing import PATIENCE_S, address, keep, violations


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
    page.get_by_text("This service needs its token").wait_for()
    keep(page, pictures_folder / "sign-in.webp")
    assert violations(page) == []
    page.get_by_label("Token", exact=True).fill("guess")
    page.get_by_role("button", name="Sign in").click()
    page.get_by_text("does not open the service").wait_for()
    page.get_by_label("Token", exact=True).fill(phone)
    page.get_by_role("button", name="Sign in").click()
    page.get_by_text("connected", exact=True).wait_for()
    assert address(page).endswith("?page=setup")  # where it was to go

    tokens = page.locator(".panel:has(h2:text-is('Tokens'))")
    tokens.get_by_role("row").filter(has_text="laptop").get_by_text("revoked").wait_for()
    tokens.get_by_role("row").filter(has_text="phone").wait_for()
    token(data, "create", "tablet")
    tokens.get_by_role("button", name="Look again").click()
    tablet = tokens.get_by_role("row").filter(has_text="tablet")
    tablet.wait_for()
    token(data, "revoke", "tablet")
    tokens.get_by_role("button", name="Look again").click()
    tablet.wait_for(state="detached")

    token(data, "revoke", "phone")
    page.get_by_text("This service needs its token").wait_for()  # by itself, when it next asks for anything
    keep(page, pictures_folder / "signed-out.webp")
    assert violations(page) == []
    assert page.locator(".band").count() == 0
    page.get_by_label("Token", exact=True).fill(phone)
    page.get_by_role("button", name="Sign in").click()
    page.get_by_text("does not open the service").wait_for()
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
