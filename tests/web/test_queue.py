"""The queue on the Live page, and names of reconstructions."""

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from browsing import PHONE, finished, keep, until, violations
from spiked_service.base.ids import new_id
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.rows import JobState, ReconstructionRow

SOURCE = "sim:?width=160&height=100&pace=0"


def test_queued_ones_are_moved_held_named_and_cancelled(
    daemon: Callable[..., Any], visit: Callable[..., Any], pictures_folder: Path
) -> None:
    one = daemon("--device", SOURCE, "--no-capture")
    plan = {"source": SOURCE, "frames": 256, "name": "desk", "reconstruct": False}
    capture = one.http.post("captures", json=plan).json()["id"]
    assert finished(one.http, capture)["state"] == "complete"
    job = {"capture_id": capture, "options": {"steps": 60_000}}
    ids = [one.http.post("reconstructions", json=job).json()["id"] for _ in range(4)]
    for which, number in zip(ids, ("first", "second", "third", "fourth"), strict=True):
        one.http.patch(f"reconstructions/{which}", json={"name": number})
    page = visit(one.address)

    def names() -> list[str]:
        return page.locator("ol.queue a").all_inner_texts()

    until(lambda: names() == ["first", "second", "third", "fourth"], "all are listed")
    earlier = page.get_by_role("button", name="Earlier: the reconstruction of fourth")
    earlier.focus()
    page.keyboard.press("Enter")
    until(lambda: names() == ["first", "second", "fourth", "third"], "it has moved up")
    page.get_by_role("button", name="Later: the reconstruction of second").click()
    until(lambda: names() == ["first", "fourth", "second", "third"], "it has moved down")
    page.get_by_role("button", name="Hold the reconstruction of fourth").click()
    page.locator("ol.queue").get_by_text("held: others go before it").wait_for()
    assert one.http.get(f"reconstructions/{ids[3]}").json()["held"]
    assert violations(page) == []
    page.locator("ol.queue").scroll_into_view_if_needed()
    keep(page, pictures_folder / "queue-dark.webp")
    page.get_by_role("button", name="Cancel the reconstruction of second").click()
    page.get_by_role("button", name="Cancel the reconstruction of first").click()
    until(lambda: one.http.get(f"reconstructions/{ids[2]}").json()["state"] == "running", "the third, not the held one")
    page.get_by_role("button", name="Let go of the reconstruction of fourth").click()
    until(lambda: not one.http.get(f"reconstructions/{ids[3]}").json()["held"], "let go")
    until(lambda: one.http.get(f"reconstructions/{ids[2]}").json()["progress"] > 0.001, "it refines")
    page.get_by_role("button", name="Pause the reconstruction of third").click()
    page.locator("ol.queue").get_by_text("it goes on from there when it is let go").wait_for()
    until(lambda: one.http.get(f"reconstructions/{ids[3]}").json()["state"] == "running", "the fourth instead")
    keep(page, pictures_folder / "queue-paused.webp")

    page = visit(
        f"{one.address}?page=captures&capture={capture}&reconstruction={ids[3]}", viewport=PHONE, theme="light"
    )
    page.get_by_label("Name of the reconstruction").fill("sharp")
    page.get_by_label("Name of the reconstruction").press("Enter")
    page.get_by_label("Notes on the reconstruction").fill("with 60,000 steps")
    page.keyboard.press("Tab")
    row = page.locator("table.jobs tr").filter(has_text="sharp")
    row.get_by_text("with 60,000 steps").wait_for()
    noted = one.http.get(f"reconstructions/{ids[3]}").json()
    assert (noted["name"], noted["notes"]) == ("sharp", "with 60,000 steps")
    assert violations(page) == []
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    keep(page, pictures_folder / "named-phone.webp")


def test_of_a_long_queue_the_first_hundred_are_listed(daemon: Callable[..., Any], visit: Callable[..., Any]) -> None:
    one = daemon("--device", SOURCE, "--no-capture")
    plan = {"source": SOURCE, "frames": 256, "reconstruct": False}
    capture = one.http.post("captures", json=plan).json()["id"]
    assert finished(one.http, capture)["state"] == "complete"
    one.close()
    catalogue, ids = Catalogue(one.data / "catalogue.sqlite"), [new_id() for _ in range(301)]
    row = ReconstructionRow("", capture, False, JobState.QUEUED, datetime.now(UTC), ReconstructionOptions(steps=60_000))
    with catalogue.transaction():
        for number, job_id in enumerate(ids):
            catalogue.reconstructions.put(replace(row, id=job_id, name=f"job {number}", held=number > 0))
    catalogue.close()
    one = daemon("--device", SOURCE, "--no-capture")
    until(lambda: one.http.get(f"reconstructions/{ids[0]}").json()["state"] == "running", "the first one begins")
    page = visit(one.address)
    links = page.locator("ol.queue a")

    def is_listed(*numbers: int) -> bool:
        return bool(links.all_inner_texts() == [f"job {number}" for number in numbers])

    until(lambda: is_listed(0, *range(1, 101)), "the one that runs and the front of the queue are listed")
    page.get_by_text("and 200 more").wait_for()
    job = {"capture_id": capture, "priority": -1}
    places = [one.http.post("reconstructions", json=job).json()["queue_place"] for _ in range(2)]
    page.get_by_text("and 202 more").wait_for()
    assert places == [301, 302] and links.count() == 101
    page.get_by_role("button", name="Cancel the reconstruction of job 1", exact=True).click()
    until(lambda: is_listed(0, *range(2, 102)), "the next one moves up")
    page.get_by_text("and 201 more").wait_for()
    one.http.patch(f"reconstructions/{ids[300]}", json={"queue_place": 1}).raise_for_status()
    until(lambda: is_listed(0, 300, *range(2, 101)), "it comes from far behind to the front")
    assert violations(page) == []
