"""A region of the picture, a pixel of it, and the moment that they are of."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from browsing import PHONE, finished, keep, until, violations

SOURCE = "sim:?width=160&height=100&pace=0"


def test_a_region_is_drawn_typed_and_measured_and_a_pixel_shows_its_spikes_and_depth(
    daemon: Callable[..., Any], visit: Callable[..., Any], pictures_folder: Path
) -> None:
    one = daemon("--device", SOURCE, "--no-capture")
    plan = {"source": SOURCE, "frames": 1000, "name": "desk", "options": {"steps": 40}}
    capture = one.http.post("captures", json=plan).json()["id"]
    assert finished(one.http, capture)["state"] == "complete"
    page = visit(one.address)
    overlay = page.locator("svg.region")
    overlay.wait_for()
    box = overlay.bounding_box()

    def drag(*shares: float) -> None:
        x0, y0, x1, y1 = shares
        page.mouse.move(box["x"] + x0 * box["width"], box["y"] + y0 * box["height"])
        page.mouse.down()
        page.mouse.move(box["x"] + x1 * box["width"], box["y"] + y1 * box["height"], steps=4)
        page.mouse.up()

    def numbers() -> dict[str, int]:
        return {
            side: int(page.get_by_label(label, exact=True).input_value())
            for side, label in (("x", "Left"), ("y", "Top"), ("width", "Width"), ("height", "Height"))
        }

    drag(0.25, 0.2, 0.75, 0.6)
    panel = page.get_by_role("region", name="Region of interest")
    panel.get_by_text("pixels:").wait_for()
    drawn = numbers()
    assert abs(drawn["x"] - 40) <= 1 and abs(drawn["width"] - 80) <= 2 and abs(drawn["height"] - 40) <= 2
    told = one.http.get(f"captures/{capture}/stats", params=drawn).json()
    panel.get_by_text(f"{told['mean_rate']:.3f} a frame").wait_for()
    page.get_by_text(f"mean {told['mean_rate']:.3f}").wait_for()  # of the histogram, too
    page.get_by_label("Width", exact=True).fill("7")
    page.get_by_label("Height", exact=True).fill("500")
    assert numbers()["height"] == 100 - drawn["y"], "kept within the picture"
    assert violations(page) == []
    keep(page, pictures_folder / "region.webp")

    drag(0.5, 0.5, 0.5, 0.5)
    pixel = numbers()
    assert (pixel["width"], pixel["height"]) == (1, 1)
    at = {"x": pixel["x"], "y": pixel["y"]}

    def shows_what_the_service_says(frame: int) -> None:
        spikes = one.http.get(f"captures/{capture}/spikes", params={**at, "frame": frame}).json()
        point = one.http.get(f"captures/{capture}/point", params={**at, "frame": frame}).json()
        panel.get_by_text(f"{len(spikes['spikes'])} spikes in").wait_for()
        until(lambda: panel.locator("figure.spikes line").count() == len(spikes["spikes"]), "each has a line")
        panel.get_by_text(f"{point['depth']:.3f} units deep").wait_for()

    shows_what_the_service_says(500)
    moment = page.get_by_label("Moment")
    assert (moment.get_attribute("min"), moment.get_attribute("max")) == ("0", "999")
    moment.fill("900")
    page.get_by_text("frame 900").wait_for()
    shows_what_the_service_says(900)
    moment.press("ArrowLeft")
    page.get_by_text("frame 899").wait_for()
    assert violations(page) == []
    keep(page, pictures_folder / "pixel.webp")
    panel.get_by_role("button", name="All pixels").click()
    page.get_by_text("click for a pixel").wait_for()

    page = visit(one.address, viewport=PHONE, theme="light")
    page.get_by_role("button", name="take the middle").click()
    page.get_by_text("4,000 pixels").or_(page.get_by_text("4\u202f000 pixels")).wait_for()
    assert violations(page) == []
    keep(page, pictures_folder / "region-phone.webp")
