"""Pages come in files of their own, which may not arrive."""

import re
from typing import Any

from browsing import Studied


def test_a_page_that_cannot_be_loaded_says_so_and_is_loaded_again(studied: Studied, browser: Any) -> None:
    with browser.new_context() as context:
        page = context.new_page()
        page.route(re.compile(r"/assets/SetupPage"), lambda route: route.abort())
        page.goto(studied.address)
        page.get_by_role("link", name="Set-up").first.click()
        page.get_by_text("Error on this page").wait_for()
        page.unroute_all()
        page.get_by_role("button", name="Try again").click()
        page.get_by_role("heading", name="Set-up").wait_for(state="attached")
        page.get_by_role("link", name="Live").first.click()
        page.get_by_role("heading", name="Live").wait_for(state="attached")
