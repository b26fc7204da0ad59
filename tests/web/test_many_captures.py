"""The Captures page with ten thousand captures: found, sorted and listed over all of them."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from browsing import address, finished, until, violations
from spiked_service.store.catalogue import Catalogue

from tests.many_captures import MANY, many

FIRST = 25
"""Rows of the first page."""


@pytest.fixture(scope="module")
def house(daemon_class: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A daemon whose catalogue gets them while it runs: its start would look for their recordings."""
    one = daemon_class("--no-capture", "--device", "sim:", folder=tmp_path_factory.mktemp("house"))
    catalogue = Catalogue(one.data / "catalogue.sqlite")
    with catalogue.transaction():
        for row in many():
            catalogue.captures.put(row)
    catalogue.close()
    assert one.http.get("captures", params={"limit": 1}).json()["total"] == MANY
    yield one
    one.close()


def names(page: Any) -> list[str]:
    """Of the captures that are listed; of one without a name its source, without the time that the page adds."""
    found: list[str] = page.locator(".list tbody th a").all_inner_texts()
    return [one.partition(", ")[0] for one in found]


def first_of(house: Any, **order: Any) -> list[str]:
    """Names that the service lists first, as the page writes them."""
    items = house.http.get("captures", params={"limit": 5, **order}).json()["items"]
    return [one["name"] or one["source"].partition("?")[0] for one in items]


def test_each_column_sorts_over_all_captures(house: Any, visit: Callable[..., Any], pictures_folder: Path) -> None:
    page = visit(f"{house.address}?page=captures")
    page.get_by_text("of 10").wait_for()
    until(lambda: names(page)[:5] == first_of(house), "the newest first")
    for column, sort, descending in (
        ("Name", "name", False),
        ("Size", "size", True),
        ("Length", "length", True),
        ("Verdict", "verdict", True),
        ("Reconstruction", "reconstruction", True),
        ("Started", "started", True),
    ):
        head = page.locator(".list thead th").filter(has_text=column)
        for way in (descending, not descending):
            head.get_by_role("button").click()
            wanted = first_of(house, sort=sort, descending=way)
            until(lambda wanted=wanted: names(page)[:5] == wanted, f"by {sort}, {'down' if way else 'up'}")
            assert head.get_attribute("aria-sort") == ("descending" if way else "ascending")
    assert violations(page) == []
    page.screenshot(path=pictures_folder / "many.png")


def test_more_are_fetched_by_scrolling_and_a_new_capture_leaves_them(house: Any, visit: Callable[..., Any]) -> None:
    page = visit(house.address)
    page.get_by_role("link", name="Captures").first.click()
    until(lambda: len(names(page)) == FIRST, "the first ones, and no more than are soon seen")
    assert page.locator("*").count() < 30 * FIRST + 400, "elements"
    page.get_by_role("button", name="Show more").scroll_into_view_if_needed()
    until(lambda: len(names(page)) > FIRST, "more")
    page.mouse.wheel(0, -1_000_000)
    shown = len(names(page))
    plan = {"source": "sim:?width=64&height=48", "frames": 64, "name": "the last", "reconstruct": False}
    answer = house.http.post("captures", json=plan)
    assert answer.status_code == 201, answer.text
    made = answer.json()["id"]
    until(lambda: names(page)[0] == "the last", "it comes first")
    assert len(names(page)) >= shown
    finished(house.http, made)
    house.http.delete(f"captures/{made}")


def test_a_new_capture_is_told_where_the_order_is_another(house: Any, visit: Callable[..., Any]) -> None:
    page = visit(f"{house.address}?page=captures")
    page.get_by_label("Order").select_option(label="largest first")
    largest = first_of(house, sort="size", descending=True)
    until(lambda: names(page)[:5] == largest, "the largest first")
    plan = {"source": "sim:?width=64&height=48", "frames": 64, "name": "!one more", "reconstruct": False}
    answer = house.http.post("captures", json=plan)
    assert answer.status_code == 201, answer.text
    made = answer.json()["id"]
    page.get_by_text("There are new captures.").wait_for()
    assert names(page)[:5] == largest
    page.get_by_label("Order").select_option(label="by name")
    until(lambda: names(page)[0] == "!one more", "it is found")
    assert page.get_by_text("There are new captures.").count() == 0
    finished(house.http, made)
    house.http.delete(f"captures/{made}")


def test_a_filter_chooses_among_all(house: Any, visit: Callable[..., Any]) -> None:
    page = visit(f"{house.address}?page=captures")
    page.get_by_label("Filter").select_option("bad")
    total = house.http.get("captures", params={"grade": "bad", "limit": 1}).json()["total"]
    assert 2000 < total < 3000
    until(lambda: str(total)[1:] in page.locator(".below").inner_text(), "their number")
    page.get_by_label("Search captures").fill("room 000")
    found = house.http.get("captures", params={"grade": "bad", "q": "room 000", "limit": 200}).json()
    assert found["total"] < FIRST
    until(lambda: names(page) == [one["name"] for one in found["items"]], "all that match both")


def test_filter_and_order_are_in_the_address(house: Any, visit: Callable[..., Any]) -> None:
    page = visit(f"{house.address}?page=captures")
    page.get_by_label("Filter").select_option("bad")
    page.locator(".list thead th").filter(has_text="Name").get_by_role("button").click()
    until(lambda: address(page).endswith("?page=captures&filter=bad&sort=name&ascending=1"), "the address")
    wanted = first_of(house, grade="bad", sort="name", descending=False)
    until(lambda: names(page)[:5] == wanted, "the first bad ones by name")

    def kept() -> bool:
        shown = page.get_by_label("Filter").input_value(), page.get_by_label("Order").locator(":checked").inner_text()
        return shown == ("bad", "by name") and names(page)[:5] == wanted

    page.reload()
    until(kept, "after a reload")
    page.locator(".list tbody th a").first.click()
    page.get_by_role("button", name="All captures").wait_for()
    page.go_back()
    until(kept, "after a step back")
    page.locator(".list tbody th a").first.click()
    page.get_by_role("button", name="All captures").click()
    until(kept, "in the list of all")
    page.get_by_label("Filter").select_option("")
    page.get_by_label("Order").select_option(label="newest first")
    until(lambda: address(page).endswith("?page=captures"), "what is usual is not named")
    page.goto(f"{house.address}?page=captures&filter=attic&sort=colour")
    until(lambda: names(page)[:5] == first_of(house), "what a link makes up is ignored")
