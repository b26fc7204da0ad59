"""`/docs` in a browser: every operation is listed, and one can be tried."""

from collections.abc import Callable
from typing import Any

import httpx
from browsing import until


def test_every_operation_is_listed_and_can_be_tried(visit: Callable[..., Any], daemon: Callable[..., Any]) -> None:
    address = daemon("--device", "sim:", "--no-capture").address
    paths = httpx.get(f"{address}openapi.json").json()["paths"]
    page = visit(f"{address}docs")
    page.locator(".opblock").first.wait_for()
    assert page.locator(".opblock").count() == sum(len(methods) for methods in paths.values())
    health = page.locator(".opblock", has_text="/healthz")
    health.locator("button.opblock-summary-control").click()
    health.get_by_role("button", name="Try it out").click()
    health.get_by_role("button", name="Execute").click()
    until(lambda: health.locator(".live-responses-table .response-col_status").count(), "a response")
    assert "200" in health.locator(".live-responses-table .response-col_status").last.inner_text()
