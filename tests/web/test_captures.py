"""The Captures page: found, looked at, reconstructed once more, compared, deleted and brought back."""

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from browsing import STEPS, Studied, address, finished, until, violations

from spiked.export import KINDS


def test_a_capture_is_found_and_looked_at(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=captures")
    row = page.get_by_role("row").filter(has_text="desk, by hand")
    row.wait_for()
    assert "good" in row.inner_text()
    assert "51.2" in row.inner_text()  # milliseconds
    row.get_by_text("complete").wait_for()  # its reconstruction
    until(lambda: row.locator("img").evaluate("image => image.naturalWidth") > 0, "a thumbnail")
    page.get_by_label("Search captures").fill("no such thing")
    page.get_by_text("No capture matches").wait_for()
    page.get_by_label("Search captures").fill("DESK")
    row.wait_for()
    assert "search=DESK" in address(page)

    row.get_by_role("link").click()
    notes = page.get_by_label("Notes on the capture")
    notes.fill("the lamp was off")
    notes.blur()
    until(
        lambda: studied.http.get(f"captures/{studied.capture_id}").json()["notes"] == "the lamp was off", "kept notes"
    )
    tags = page.get_by_label("Tags")
    tags.fill("desk,  by night, desk")
    tags.blur()
    until(
        lambda: studied.http.get(f"captures/{studied.capture_id}").json()["tags"] == ["desk", "by night"], "kept tags"
    )
    page.go_back()
    page.get_by_label("Search captures").fill("lamp")
    row.wait_for()
    assert "the lamp was off" in row.inner_text() and "#desk #by night" in row.inner_text()
    row.get_by_role("link").click()
    page.get_by_text("Over time").wait_for()
    assert studied.capture_id in address(page)
    for plot in ("Pose σ", "χ²", "Loss", "PSNR estimate", "Spike rate", "Flicker"):
        page.locator(f"figure.plot:has(figcaption:has-text('{plot}')) canvas").wait_for()
    page.get_by_role("radio", name="Work").check()
    over = page.get_by_role("img", name=re.compile(r"^Loss over seconds of work\. .*From .+ to .+"))
    over.wait_for()
    assert page.locator("figure.plot:has(figcaption:has-text('Flicker'))").count() == 0, "light knows no work"
    page.get_by_role("radio", name="Capture", exact=True).check()
    page.get_by_role("img", name=re.compile(r"^Loss over time")).wait_for()
    page.get_by_text("No frames are missing").wait_for()
    assert f"steps\n{STEPS}" in page.locator(".panel:has(h2:text-is('Options used'))").inner_text()
    page.locator("summary").filter(has_text="Log").click()
    until(lambda: len(page.locator(".log pre").inner_text()) > 10, "a log")


def test_what_another_has_written_is_kept_by_a_visit_of_the_field(studied: Studied, visit: Callable[..., Any]) -> None:
    fields = {
        "Notes on the capture": ("captures", studied.capture_id, "notes"),
        "Name of the capture": ("captures", studied.capture_id, "name"),
        "Name of the reconstruction": ("reconstructions", studied.reconstruction_id, "name"),
        "Notes on the reconstruction": ("reconstructions", studied.reconstruction_id, "notes"),
    }
    page = visit(f"{studied.address}?page=captures&capture={studied.capture_id}")
    for label, (kind, id_, key) in fields.items():
        field = page.get_by_label(label)
        field.wait_for()
        before = studied.http.get(f"{kind}/{id_}").json()[key]
        studied.http.patch(f"{kind}/{id_}", json={key: "by another"})
        until(lambda field=field: field.input_value() == "by another", f"what another wrote in {label}", 20)
        field.focus()
        field.blur()
        field.fill("a slip")
        field.press("Escape")
        field.blur()
        assert field.input_value() == "by another"
        page.wait_for_timeout(300)
        assert studied.http.get(f"{kind}/{id_}").json()[key] == "by another"
        studied.http.patch(f"{kind}/{id_}", json={key: before})


def test_an_old_capture_is_followed_without_messages(studied: Studied, visit: Callable[..., Any]) -> None:
    """One that is not among the newest, which alone are fetched for all pages, while the WebSocket is not there."""
    page = visit("about:blank")
    page.route_web_socket("**/api/v1/events?*", lambda socket: socket.close())
    page.route("**/api/v1/captures?*", lambda route: route.fulfill(json={"items": [], "next_cursor": None, "total": 0}))
    page.goto(f"{studied.address}?page=captures&capture={studied.capture_id}")
    name = page.get_by_label("Name of the capture")
    name.wait_for()
    before = studied.http.get(f"captures/{studied.capture_id}").json()["name"]
    studied.http.patch(f"captures/{studied.capture_id}", json={"name": "by another"})
    try:
        until(lambda: name.input_value() == "by another", "what another wrote")
    finally:
        studied.http.patch(f"captures/{studied.capture_id}", json={"name": before})


def test_how_much_is_refined_is_read_to_its_end(studied: Studied, visit: Callable[..., Any]) -> None:
    plan = {"capture_id": studied.capture_id, "options": {"steps": 200_000}}
    job = studied.http.post("reconstructions", json=plan).json()["id"]
    try:
        page = visit(f"{studied.address}?page=scene&capture={studied.capture_id}&reconstruction={job}")
        text = page.locator(".inspector .refining span")
        text.get_by_text("left").wait_for()
        bounds, panel = text.bounding_box(), page.locator(".inspector").bounding_box()
        assert bounds["x"] + bounds["width"] <= panel["x"] + panel["width"]
    finally:
        studied.http.post(f"reconstructions/{job}:cancel")
        until(lambda: studied.http.get(f"reconstructions/{job}").json()["state"] == "cancelled", "it has ended")
        studied.http.delete(f"reconstructions/{job}")


def test_everything_can_be_downloaded(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=captures&capture={studied.capture_id}")
    page.get_by_role("link", name="nerfstudio").wait_for()
    targets = page.eval_on_selector_all("a[download]", "links => links.map(link => link.href)")
    assert len(targets) == 10
    page.get_by_role("group", name="Path alone").get_by_text("Path alone").wait_for()  # COLMAP without a scene
    for target in targets:
        answer = studied.http.get(target)
        assert answer.status_code == 200, target
        assert answer.content, target
    page.locator("summary", has_text="For other programs").click()
    page.get_by_role("link", name="mesh-glb").wait_for()
    offered = page.locator(".exports a[download]")
    assert offered.count() == len(KINDS)
    answer = studied.http.get(page.get_by_role("link", name="compressed-ply").evaluate("link => link.href"))
    assert answer.status_code == 200 and answer.content.startswith(b"ply")


@pytest.mark.slow
def test_missing_frames_are_listed_with_their_cause(studied: Studied, visit: Callable[..., Any], room: Path) -> None:
    plan = {"source": f"replay:{room}?gap=700:40:usb", "name": "a gap", "options": {"steps": 20}}
    capture_id = studied.http.post("captures", json=plan).json()["id"]
    until(lambda: studied.http.get(f"captures/{capture_id}").json()["verdict"], "it is recorded", 300)
    page = visit(f"{studied.address}?page=captures&capture={capture_id}")
    row = page.locator("table.gaps tbody tr")
    row.wait_for()
    assert row.inner_text().split("\t") == ["frame 700, 35.00 ms", "40", "usb"]
    assert "40" in page.locator(".verdict.warning").inner_text()  # degraded, and why
    studied.http.post(f"captures/{capture_id}:stop")  # what was missed is known; the refinement need not be waited for
    finished(studied.http, capture_id)
    studied.http.delete(f"captures/{capture_id}")


@pytest.mark.slow
def test_renamed_rerun_and_compared(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=captures&capture={studied.capture_id}")
    name = page.get_by_label("Name of the capture")
    name.fill("desk, by hand, again")
    name.press("Enter")
    until(
        lambda: studied.http.get(f"captures/{studied.capture_id}").json()["name"] == "desk, by hand, again",
        "the service knows the name",
    )
    page.get_by_role("button", name="Re-run with other options").click()
    page.get_by_label(re.compile("^steps")).fill("50")
    page.get_by_role("button", name="Reconstruct", exact=True).click()
    compared = page.locator("table.compared")
    compared.wait_for()
    jobs = studied.http.get("reconstructions", params={"capture_id": studied.capture_id}).json()["items"]
    again = next(job for job in jobs if not job["live"])
    assert again["options"]["steps"] == 50
    until(
        lambda: studied.http.get(f"reconstructions/{again['id']}").json()["state"] == "complete",
        "it is reconstructed",
        300,
    )
    until(lambda: compared.locator("tbody tr").first.inner_text().split("\t")[1].strip() != "0", "its poses are shown")
    legend = page.locator("figure.plot:has(figcaption:has-text('Loss')) .u-legend")
    until(lambda: "#1" in legend.inner_text() and "#2" in legend.inner_text(), "both are in one plot")


def test_a_rerun_is_given_poses_optics_and_time(studied: Studied, visit: Callable[..., Any], tmp_path: Path) -> None:
    page = visit(f"{studied.address}?page=captures&capture={studied.capture_id}")
    page.get_by_role("button", name="Re-run with other options").click()
    form = page.locator(".panel:has(h2:text-is('Options of the new reconstruction')) form")
    form.wait_for()
    for named in form.locator(".field").all():
        assert len(named.locator("small").inner_text()) > 10, f"help of {named.inner_text()}"
    fields = studied.http.get("options").json()["properties"]
    assert form.locator("label").count() == len(fields) + 2, "every option, poses and calibration"
    form.get_by_label(re.compile("^steps")).fill("10")
    form.get_by_label(re.compile("^seconds")).fill("300")
    form.get_by_label(re.compile("^most splats")).fill("1500")
    form.get_by_label(re.compile("^intrinsics")).fill("280,280,160,100,0.01")
    form.get_by_label(re.compile("^mosaic")).select_option("auto")
    form.get_by_label(re.compile("^poses")).select_option("file")
    form.get_by_role("button", name="Reconstruct").click()
    page.get_by_text("Choose the TUM file").wait_for()
    path = studied.http.get(f"reconstructions/{studied.reconstruction_id}/trajectory", params={"format": "tum"})
    (tmp_path / "path.tum").write_bytes(path.content)
    form.get_by_label(re.compile("^file with poses")).set_input_files(tmp_path / "path.tum")
    form.get_by_role("button", name="Reconstruct").click()
    form.wait_for(state="detached")
    (job, *_) = studied.http.get("reconstructions", params={"capture_id": studied.capture_id}).json()["items"]
    assert job["poses_from"] == "file"
    options = job["options"]
    assert (options["seconds"], options["most_splats"], options["mosaic"]) == (300, 1500, "auto")
    assert (options["intrinsics"]["fx"], options["intrinsics"]["distortion"]["k1"]) == (280, 0.01)
    used = page.locator(".panel:has(h2:text-is('Options used'))")
    until(lambda: "poses\nof a file" in used.inner_text(), "it says where the poses are from")
    one = f"reconstructions/{job['id']}"
    until(lambda: studied.http.get(one).json()["state"] in ("complete", "failed"), "it ends", 300)
    studied.http.delete(f"reconstructions/{job['id']}")


def test_deleted_and_brought_back(studied: Studied, visit: Callable[..., Any]) -> None:
    plan = {"source": "sim:?width=64&height=48", "frames": 64, "name": "throw-away", "reconstruct": False}
    capture_id = studied.http.post("captures", json=plan).json()["id"]
    until(lambda: studied.http.get(f"captures/{capture_id}").json()["state"] == "complete", "a capture more")
    page = visit(f"{studied.address}?page=captures")
    row = page.get_by_role("row").filter(has_text="throw-away")
    page.get_by_role("button", name="Delete throw-away").click()
    row.wait_for(state="detached")
    assert studied.http.get(f"captures/{capture_id}").json()["deleted_at"] is not None
    page.get_by_role("button", name="Undo").click()
    row.wait_for()
    assert studied.http.get(f"captures/{capture_id}").json()["deleted_at"] is None
    studied.http.delete(f"captures/{capture_id}")


def test_captures_without_a_name_are_told_apart_by_time(studied: Studied, visit: Callable[..., Any]) -> None:
    plan = {"source": "sim:?width=64&height=48", "frames": 64, "reconstruct": False}
    ids: list[str] = []
    for _ in range(2):
        before = int(time.time())
        until(lambda before=before: int(time.time()) > before, "another second")
        ids.append(studied.http.post("captures", json=plan).json()["id"])
        until(lambda: studied.http.get(f"captures/{ids[-1]}").json()["state"] == "complete", "a capture more")
    page = visit(f"{studied.address}?page=captures")
    links = page.get_by_role("rowheader").get_by_role("link", name=re.compile(r"^sim:, \d\d:\d\d:\d\d$"))
    until(lambda: links.count() == 2, "both are listed")
    names = links.all_inner_texts()
    assert names[0] > names[1], "the newest first"
    page.get_by_role("checkbox", name=f"Select {names[0]}").check()
    links.first.click()
    assert page.get_by_label("Name of the capture").get_attribute("placeholder") == names[0]
    assert violations(page) == []
    for one in ids:
        studied.http.delete(f"captures/{one}")


def test_deleted_ones_are_listed_restored_and_deleted_for_good(studied: Studied, visit: Callable[..., Any]) -> None:
    plan = {"source": "sim:?width=64&height=48", "frames": 64, "reconstruct": False}
    ids = []
    for name in ("first waste", "second waste"):
        ids.append(studied.http.post("captures", json=plan | {"name": name}).json()["id"])
        until(lambda: studied.http.get(f"captures/{ids[-1]}").json()["state"] == "complete", "a capture more")
        studied.http.delete(f"captures/{ids[-1]}")
    page = visit(f"{studied.address}?page=captures")
    page.get_by_label("Filter").select_option("deleted")
    first, second = (page.get_by_role("row").filter(has_text=name) for name in ("first waste", "second waste"))
    first.wait_for()
    page.get_by_role("button", name="Restore first waste").click()
    first.wait_for(state="detached")
    assert studied.http.get(f"captures/{ids[0]}").json()["deleted_at"] is None
    page.get_by_label("Select second waste").check()
    bar = page.get_by_role("group", name="Selected captures")
    bar.get_by_role("button", name="Delete for good").click()
    bar.get_by_role("button", name="No").click()
    bar.get_by_role("button", name="Delete for good").click()
    bar.get_by_role("button", name="Yes, free the disk space").click()
    second.wait_for(state="detached")
    assert studied.http.get(f"captures/{ids[1]}").status_code == 404
    page.get_by_label("Filter").select_option("")
    first.wait_for()
    studied.http.delete(f"captures/{ids[0]}")


def test_set_up_tells_where_each_setting_comes_from(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=setup")
    row = page.locator(".configuration tr:has(th > code:text-is('port'))")
    row.wait_for()
    assert "flag" in row.inner_text()
    page.get_by_role("button", name="Reload").click()
    page.get_by_text("Nothing has changed").wait_for()
    for link in page.locator(".links a").all():
        answer = studied.http.get(studied.address + link.get_attribute("href"), follow_redirects=True)
        assert answer.status_code == 200, answer.url


def reason_in(page: Any, where: str) -> str:
    """Reason of a reconstruction in a part of the page."""
    text: str = page.locator(where).locator(".reason").first.inner_text()
    return text


def test_the_reason_of_a_failed_reconstruction_is_shown_everywhere(
    studied: Studied, visit: Callable[..., Any], room: Path
) -> None:
    plan = {"source": f"replay:{room}", "frames": 48, "name": "too short"}
    capture = finished(studied.http, studied.http.post("captures", json=plan).json()["id"])
    job = studied.http.get(f"reconstructions/{capture['reconstruction_ids'][0]}").json()
    assert job["state"] == "failed" and job["reason"]
    reason = f"Failed: {job['reason']}"
    page = visit(f"{studied.address}?page=captures")
    row = page.get_by_role("row").filter(has_text="too short")
    row.locator(".reason").wait_for()
    assert row.locator(".reason").inner_text() == reason
    row.get_by_role("link").click()
    page.locator("table.jobs .reason").wait_for()
    assert reason_in(page, "table.jobs") == reason
    page.goto(f"{studied.address}?page=scene&capture={capture['id']}")
    page.get_by_text("The reconstruction has failed").wait_for()
    assert reason_in(page, ".veil") == reason_in(page, ".inspector") == reason
    studied.http.delete(f"captures/{capture['id']}")


def test_the_reason_of_a_degraded_reconstruction_is_shown_everywhere(
    studied: Studied, visit: Callable[..., Any]
) -> None:
    """The path of the room is good: the answers of the service are changed on their way."""
    reason = "predicted path error 4.2 %"

    def degraded(job: dict[str, Any]) -> dict[str, Any]:
        return {**job, "tracking_state": "degraded", "reason": reason}

    def changed(route: Any) -> None:
        answer = route.fetch()
        body = answer.json()
        page_of_jobs = "items" in body
        body = {**body, "items": [degraded(one) for one in body["items"]]} if page_of_jobs else degraded(body)
        route.fulfill(response=answer, json=body)

    page = visit("about:blank")
    page.route(re.compile(r"/reconstructions(\?|/[0-9a-f-]+$)"), changed)
    page.goto(f"{studied.address}?page=captures")
    row = page.get_by_role("row").filter(has=page.get_by_text("complete, degraded")).first
    row.wait_for()
    assert row.locator(".reason").inner_text() == f"degraded: {reason}"
    page.goto(f"{studied.address}?page=captures&capture={studied.capture_id}")
    page.locator("table.jobs .reason").first.wait_for()
    assert reason_in(page, "table.jobs") == f"degraded: {reason}"
    page.goto(f"{studied.address}?page=scene&capture={studied.capture_id}")
    page.locator(".inspector .reason").wait_for()
    assert reason_in(page, ".inspector") == f"degraded: {reason}"


@pytest.mark.slow
def test_a_recording_is_found_in_a_map_and_shown_in_its_scene(studied: Studied, visit: Callable[..., Any]) -> None:
    page = visit(f"{studied.address}?page=captures&capture={studied.capture_id}")
    page.get_by_role("button", name="Use a map").click()
    form = page.locator(".panel:has(h2:text-is('Use a map'))")
    form.get_by_text("Both have to show the same place").wait_for()
    listed = studied.http.get("reconstructions").json()["items"]
    maps = [one for one in listed if one["task"] != "localise" and one["version"] > 0]
    assert form.locator("select").nth(1).locator("option").count() == len(maps) > 0
    form.get_by_role("button", name="Start").click()
    row = page.locator("table.jobs tbody tr").filter(has_text="found in a map")
    row.wait_for()
    jobs = studied.http.get("reconstructions", params={"capture_id": studied.capture_id}).json()["items"]
    made = next(one for one in jobs if one["task"] == "localise")
    until(lambda: studied.http.get(f"reconstructions/{made['id']}").json()["state"] == "complete", "it is found", 300)
    row.get_by_text("complete").wait_for()
    row.get_by_role("button", name="Scene of reconstruction").click()
    page.locator("canvas").first.wait_for()
    until(lambda: made["id"] in address(page), "its scene")
    studied.http.delete(f"reconstructions/{made['id']}")
