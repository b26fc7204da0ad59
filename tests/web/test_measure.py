"""Metres and up on the Scene page, of a map of a rig of two cameras that shows a board."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import DESKTOP, PHONE, keep, shown_version, until, violations
from published_map import published_map
from spiked_service.results.versions import RecordedPath
from spiked_service.store.rows import Plan
from tag_card import board_card, card_scene

from spiked.recording import RecordingWriter
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory

from ..service.survival import kept, over
from .conftest import running

SENSOR = Sensor(400, 248, 20_000.0)
DISTANCE = 0.12
"""Of the two cameras in the scene, which is in metres."""


class Rig:
    """A daemon with the map."""

    def __init__(self, daemon: Any, capture_id: str, map_id: str, path: Trajectory) -> None:
        self.address = f"{daemon.address}?page=scene&capture={capture_id}"
        self.http = daemon.http
        self.url = f"reconstructions/{map_id}/scale"
        self.path = path

    def scale(self) -> dict[str, Any]:
        found: dict[str, Any] = self.http.get(self.url).json()
        return found


@pytest.fixture(scope="module")
def rig(daemon_class: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("measured") / "daemon"
    folder.mkdir()
    with RecordingWriter(folder / "dark.dat", SENSOR) as writer:
        writer.append(np.zeros((256, SENSOR.frame_bytes), np.uint8))
    scene, path, camera = card_scene(board_card())
    beside = Trajectory(path.times_s, path.rotations, path.centres + path.rotations @ [DISTANCE, 0, 0])
    with kept(folder / "data") as store:
        plan = Plan(f"replay:{folder / 'dark.dat'}?pace=0", reconstruct=False)
        first, second = (over(store, store.captures.start(plan).id).id for _ in range(2))
        others = [RecordedPath(second, SENSOR.frame_rate_hz, beside)]
        map_id = published_map(store, first, scene, path, camera.intrinsics, others=others)
    with running(daemon_class, folder) as daemon:
        yield Rig(daemon, first, map_id, path)


@pytest.fixture
def measuring(rig: Rig, visit: Callable[..., Any]) -> Callable[..., Any]:
    """Opens the tool, while nothing is known."""

    def open_tool(**more: Any) -> Any:
        rig.http.delete(rig.url)
        page = visit(rig.address, **more)
        until(lambda: shown_version(page) > 0, "a scene is on the canvas")
        page.get_by_text("Measure", exact=True).click()
        page.get_by_text("The scale is not known").wait_for()
        return page

    return open_tool


@pytest.mark.parametrize("viewport", [DESKTOP, PHONE])
def test_a_board_gives_metres(
    rig: Rig, measuring: Callable[..., Any], viewport: dict[str, int], pictures_folder: Path
) -> None:
    page = measuring(viewport=viewport)
    page.get_by_text("By a board or two cameras").click()
    page.get_by_role("button", name="Find the board").click()
    page.get_by_text("the board is in 0 of the pictures").wait_for()
    page.get_by_label("Squares of the board in a row").fill("7")
    page.get_by_label("Squares of the board in a column").fill("5")
    page.get_by_label("Side of a square of the board in metres").fill("0.03")
    page.get_by_role("button", name="Find the board").click()
    page.get_by_text(", by a board.").wait_for()
    assert rig.scale()["source"] == "board" and rig.scale()["metres_per_unit"] == pytest.approx(1, abs=3e-3)
    assert violations(page) == []
    assert page.evaluate("() => document.documentElement.scrollWidth") <= viewport["width"]
    keep(page, pictures_folder / f"measure-{viewport['width']}.webp")


def test_a_length_is_seen_beside_its_points(measuring: Callable[..., Any]) -> None:
    """On a phone the tool is far below the scene that is tapped."""
    page = measuring(viewport=PHONE, touch=True)
    notes = page.locator(".stage-notes")
    notes.get_by_text("Tap or click two points.").wait_for()
    page.evaluate("() => scrollTo(0, 0)")
    box = page.locator(".stage canvas").bounding_box()
    y = box["y"] + box["height"] / 2
    page.touchscreen.tap(box["x"] + 0.3 * box["width"], y)
    notes.get_by_text("1 of 2 points").wait_for()
    page.touchscreen.tap(box["x"] + 0.55 * box["width"], y + 0.13 * box["height"])
    found = notes.get_by_text(re.compile(r"^\d+\.\d+\sunits$"))
    found.wait_for()
    bounds = found.bounding_box()
    assert bounds["y"] >= 0 and bounds["y"] + bounds["height"] <= PHONE["height"]
    page.get_by_text("Measure", exact=True).click()
    found.wait_for(state="detached")


def test_two_cameras_at_a_known_distance_give_metres(rig: Rig, measuring: Callable[..., Any]) -> None:
    page = measuring(theme="light")
    page.get_by_text("By a board or two cameras").click()
    page.get_by_label("Distance of the two cameras in metres").fill("0.24")
    page.get_by_label("Distance of the two cameras in metres").press("Enter")
    page.get_by_text("the offset of the two recordings is not known").wait_for()
    assert rig.scale()["metres_per_unit"] is None
    page.get_by_label("Seconds by which the second camera began later").fill("0")
    page.get_by_label("Seconds by which the second camera began later").press("Enter")
    page.get_by_text(", by the distance of two cameras.").wait_for()
    assert rig.scale()["metres_per_unit"] == pytest.approx(0.24 / DISTANCE, rel=1e-5)
    assert violations(page) == []


def test_up_is_found_by_the_floor_or_given_by_gravity(
    rig: Rig, measuring: Callable[..., Any], pictures_folder: Path
) -> None:
    page = measuring(viewport=PHONE)
    page.get_by_role("radio", name="Up").check()
    page.get_by_role("button", name="Find the floor").click()
    page.get_by_text("Up is known").wait_for()
    assert np.degrees(np.arccos(np.array(rig.scale()["up"])[2])) < 2, "z is up in the room"
    page.get_by_text("By gravity", exact=True).click()
    gravity = page.get_by_label("Gravity in the axes of the camera")
    gravity.fill("down")
    gravity.press("Enter")
    page.get_by_text("Write three numbers").wait_for()
    gravity.fill("0, 9.81, 0")
    gravity.press("Enter")
    down = rig.path.rotations[0][:, 1]
    until(lambda: np.allclose(rig.scale()["up"], -down, atol=1e-6), "up against the camera's y axis")
    assert violations(page) == []
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    keep(page, pictures_folder / "measure-up.webp")
