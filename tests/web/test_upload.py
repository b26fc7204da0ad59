"""The upload form: a recording with its sidecar or described by hand, refused files, on a desktop and on a phone."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import DESKTOP, PHONE, address, keep, until, violations

from spiked.calibration import Calibration

WIDTH, HEIGHT, FRAMES = 160, 96, 200


@pytest.fixture(scope="module")
def idle(daemon_class: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A daemon without captures."""
    daemon = daemon_class("--no-capture", "--device", "sim:", folder=tmp_path_factory.mktemp("upload"))
    yield daemon
    daemon.close()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of noise, the sidecar that belongs to them, and a calibration."""
    folder = tmp_path_factory.mktemp("files")
    frames = np.random.default_rng(1).integers(0, 256, (FRAMES, WIDTH * HEIGHT // 8), np.uint8) & 0x11
    (folder / "desk.dat").write_bytes(frames.tobytes())
    sidecar = {"format": "compact", "width": WIDTH, "height": HEIGHT, "frame_rate": 20_000.0, "bit_order": "lsb"}
    (folder / "desk.json").write_text(json.dumps({**sidecar, "flipped": True, "frames": FRAMES, "note": "by hand"}))
    (folder / "list.json").write_text("[1, 2]")
    plain = np.ones((HEIGHT, WIDTH), np.float32)
    Calibration(plain, 0 * plain, plain < 0).write(folder / "calibration.npz")
    return folder


def opened(visit: Callable[..., Any], daemon: Any, **more: Any) -> Any:
    page = visit(f"{daemon.address}?page=captures", **more)
    page.get_by_role("button", name="Upload", exact=True).click()
    page.get_by_role("heading", name="Upload a recording").wait_for()
    return page


def choose_files(page: Any, *paths: Path) -> None:
    page.get_by_label("Files to upload").set_input_files([str(path) for path in paths])


def field(page: Any, name: str) -> Any:
    return page.locator(".upload form").get_by_label(name, exact=True)


def newest(daemon: Any) -> dict[str, Any]:
    found: dict[str, Any] = daemon.http.get("captures").json()["items"][0]
    return found


@pytest.mark.parametrize(("name", "viewport"), [("desktop", DESKTOP), ("phone", PHONE)])
def test_a_recording_with_its_sidecar_becomes_a_capture(
    idle: Any, visit: Callable[..., Any], files: Path, pictures_folder: Path, name: str, viewport: dict[str, int]
) -> None:
    page = opened(visit, idle, viewport=viewport, touch=name == "phone")
    choose_files(page, files / "desk.dat", files / "desk.json", files / "calibration.npz")
    page.get_by_text(", with its sidecar").wait_for()
    assert field(page, "width").input_value() == str(WIDTH)
    page.get_by_text(f"{FRAMES} frames of 1,920 bytes, 0.01000 s.").wait_for()
    assert page.evaluate("() => document.documentElement.scrollWidth") <= viewport["width"]
    assert violations(page) == []
    keep(page, pictures_folder / f"upload-{name}.webp")
    page.get_by_role("textbox", name="Name", exact=True).fill(f"from the {name}")
    page.locator(".upload form").get_by_role("button", name="Upload").click()
    page.get_by_text("Recording", exact=True).first.wait_for()
    capture = newest(idle)
    assert (capture["name"], capture["recording"]["frames"], capture["origin"]) == (
        f"from the {name}",
        FRAMES,
        "upload",
    )
    assert capture["id"] in page.evaluate("() => location.href")
    sidecar = idle.http.get(f"captures/{capture['id']}/recording/sidecar").json()
    assert (sidecar["note"], sidecar["calibration"]) == ("by hand", "calibration.npz")


def test_what_has_no_sidecar_is_described_by_hand(idle: Any, visit: Callable[..., Any], files: Path) -> None:
    page = opened(visit, idle)
    choose_files(page, files / "desk.dat")
    form = page.locator(".upload form")
    field(page, "width").fill("168")
    field(page, "height").fill(str(HEIGHT))
    page.get_by_text("and a part of one").wait_for()
    field(page, "width").fill(str(WIDTH))
    field(page, "rate").fill("40000")
    field(page, "mosaic").select_option("BGGR")
    field(page, "intrinsics").fill("140,140,80,48")
    page.get_by_text(f"{FRAMES} frames of 1,920 bytes, 0.005000 s.").wait_for()
    form.get_by_role("button", name="Upload").click()
    page.get_by_text("Recording", exact=True).first.wait_for()
    sensor = newest(idle)["sensor"]
    assert (sensor["width"], sensor["frame_rate_hz"], sensor["mosaic"]) == (WIDTH, 40_000, "BGGR")
    assert sensor["intrinsics"]["fx"] == 140


def test_a_file_dropped_beside_the_place_for_it_is_not_opened(idle: Any, visit: Callable[..., Any]) -> None:
    page = opened(visit, idle)
    drop = "(target) => target.dispatchEvent(new DragEvent('drop', { bubbles: true, cancelable: true }))"
    assert page.locator("h1").first.evaluate(drop) is False
    assert page.locator("input[type=file]").first.evaluate(drop) is True, "the browser takes it there"


def test_what_cannot_be_used_is_told(idle: Any, visit: Callable[..., Any], files: Path) -> None:
    page = opened(visit, idle)
    choose_files(page, files / "desk.json")
    page.get_by_text("A sidecar alone is no recording").wait_for()
    choose_files(page, files / "desk.dat", files / "list.json")
    page.get_by_text("list.json is no sidecar").wait_for()
    choose_files(page, files / "desk.dat")
    form = page.locator(".upload form")
    field(page, "width").fill("12")
    field(page, "height").fill(str(HEIGHT))
    page.get_by_text("The width is not a multiple of 8.").wait_for()
    form.get_by_role("button", name="Upload").click()
    page.locator(".upload .error-message").wait_for()
    assert "cannot be used as a recording" in page.locator(".upload .error-message").inner_text()
    assert idle.http.get("uploads").json()["items"] == []


def test_an_upload_goes_on_beside_other_pages(idle: Any, visit: Callable[..., Any], files: Path) -> None:
    page = opened(visit, idle)
    held: list[Any] = []

    def hold(route: Any) -> None:
        held.append(route)

    page.route("**/api/v1/uploads/*", hold, times=1)
    choose_files(page, files / "desk.dat", files / "desk.json")
    page.get_by_role("textbox", name="Name", exact=True).fill("sent meanwhile")
    page.locator(".upload form").get_by_role("button", name="Upload").click()
    page.get_by_role("region", name="Upload of sent meanwhile").wait_for()
    page.get_by_role("link", name="Live").click()
    page.get_by_role("button", name="Cancel").wait_for()
    until(lambda: page.evaluate("() => true") and bool(held), "a piece under way")
    held[0].continue_()
    page.get_by_text("Uploaded sent meanwhile").wait_for()
    assert "page=captures" not in address(page)
    page.get_by_role("button", name="Open").click()
    page.get_by_text("Recording", exact=True).first.wait_for()
    assert newest(idle)["id"] in address(page)


def test_an_upload_goes_on_after_a_reload(idle: Any, visit: Callable[..., Any], files: Path, tmp_path: Path) -> None:
    desk = files / "desk.dat"
    page = opened(visit, idle)
    page.route("**/api/v1/uploads/*:complete", lambda route: None)
    sent = desk.stat().st_size
    page.route(  # the connection breaks after the first piece
        "**/api/v1/uploads/*", lambda route: route.abort() if route.request.method == "PATCH" else route.continue_()
    )
    choose_files(page, desk, files / "desk.json")
    page.get_by_role("button", name="Upload", exact=True).last.click()
    page.get_by_text("It waits and goes on by itself").wait_for()
    (begun,) = idle.http.get("uploads").json()["items"]
    half = sent // 2
    headers = {"content-type": "application/octet-stream", "upload-offset": "0"}
    answer = idle.http.patch(f"uploads/{begun['id']}", content=desk.read_bytes()[:half], headers=headers)
    assert answer.status_code == 200, answer.text
    page.reload()

    left = page.locator(".panel:has(h2:text-is('Unfinished uploads')) li")
    left.wait_for()
    page.unroute_all(behavior="ignoreErrors")  # not before: the page would go on by itself
    assert "desk.dat" in left.inner_text()
    assert violations(page) == []
    chosen = left.get_by_label("File of desk.dat, to go on")
    (tmp_path / "desk.dat").write_bytes(b"x" * 10)
    chosen.set_input_files(tmp_path / "desk.dat")
    left.get_by_text(f"had {sent} bytes, and now it has 10").wait_for()
    (tmp_path / "other.dat").write_bytes(desk.read_bytes())
    chosen.set_input_files(tmp_path / "other.dat")
    left.get_by_text("this is other.dat").wait_for()
    chosen.set_input_files(desk)
    left.wait_for(state="detached")
    page.get_by_text("Uploaded desk.dat").wait_for()
    made = newest(idle)
    assert made["name"] == "desk.dat" and made["recording"]["frames"] == FRAMES
    stored = idle.http.get(f"captures/{made['id']}/recording").content
    assert stored == desk.read_bytes()
    assert idle.http.get("uploads").json()["items"] == []


def test_an_unfinished_upload_is_cancelled(idle: Any, visit: Callable[..., Any]) -> None:
    answer = idle.http.post("uploads", json={"name": "left.dat", "bytes": 1000})
    assert answer.status_code == 201, answer.text
    page = visit(f"{idle.address}?page=captures")
    page.get_by_role("button", name="Cancel the upload of left.dat").click()
    until(lambda: idle.http.get("uploads").json()["items"] == [], "it is removed")
    page.get_by_text("Unfinished uploads").wait_for(state="detached")
