"""An exported page, opened from the disk: the scene and the path, without a service and without a network."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import DESKTOP, PHONE, Studied, keep, picture, still, until, violations

from spiked.export.viewer_page import SCRIPT


@pytest.mark.parametrize(("name", "viewport"), [("desktop", DESKTOP), ("phone", PHONE)])
def test_a_scene_opens_from_a_folder(
    studied: Studied, visit: Callable[..., Any], tmp_path: Path, pictures_folder: Path, name: str, viewport: Any
) -> None:
    if not SCRIPT.is_file():
        pytest.skip("the viewer is not built (make page)")
    answer = studied.http.get(f"reconstructions/{studied.reconstruction_id}/exports/viewer")
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/html"), answer.text[:300]
    assert "attachment" in answer.headers["content-disposition"]
    (tmp_path / "scene.html").write_bytes(answer.content)

    page = visit("about:blank", viewport=viewport)
    asked = list[str]()
    page.on("request", lambda request: asked.append(request.url))
    page.goto((tmp_path / "scene.html").as_uri())
    page.locator("canvas[data-version='1']").wait_for()
    until(lambda: np.ptp(picture(page)) > 0.4, "splats are drawn")
    assert all(url.startswith(("file:", "blob:", "data:")) for url in asked), asked
    assert page.title() == "desk, by hand"
    assert violations(page) == []
    keep(page, pictures_folder / f"viewer-{name}.webp")

    page.get_by_label("Through the camera").check()
    box = page.locator("canvas").bounding_box()
    assert box["width"] / box["height"] == pytest.approx(320 / 200, rel=0.02), "the shape of the sensor"
    riding = still(page)
    page.get_by_label("Moment").focus()
    page.keyboard.press("End")
    until(lambda: np.abs(picture(page) - riding).mean() > 0.01, "the camera is elsewhere")
    page.get_by_role("button", name="Play").click()  # from the beginning again
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Reset the view").click()
    assert not page.get_by_label("Through the camera").is_checked()
