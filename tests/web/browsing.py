"""What the tests of the page share: patience, a daemon with something to show, and the canvas of the scene."""

import base64
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from waiting import until

Picture = NDArray[np.float64]
PATIENCE_S = 60.0
DESKTOP = {"width": 1280, "height": 800}
PHONE = {"width": 390, "height": 844}
NODE_MODULES = Path(__file__).resolve().parents[2] / "web" / "node_modules"
AXE = NODE_MODULES / "axe-core" / "axe.min.js"
STEPS = 600 if "SCREENSHOTS" in os.environ else 150
"""Of refinement: a scene to be looked at, or one to be tested with."""
MOST_BYTES = 300_000
"""Of a screenshot."""


def finished(http: Any, capture_id: str) -> dict[str, Any]:
    """The capture when it is over."""

    def over() -> dict[str, Any] | None:
        capture: dict[str, Any] = http.get(f"captures/{capture_id}").json()
        return capture if capture["state"] in ("complete", "failed") else None

    return until(over, f"capture {capture_id} is over", 300)


class Studied:
    """A daemon that has captured and reconstructed a recording."""

    def __init__(self, daemon: Any, capture: dict[str, Any]) -> None:
        self.daemon = daemon
        self.address: str = daemon.address
        self.http = daemon.http
        self.capture_id: str = capture["id"]
        self.reconstruction_id: str = capture["reconstruction_ids"][0]

    def reconstruction(self) -> dict[str, Any]:
        """As it is now."""
        found: dict[str, Any] = self.http.get(f"reconstructions/{self.reconstruction_id}").json()
        return found


def picture(page: Any, canvas: str = ".stage canvas") -> Picture:
    """What a canvas shows, [H, W, 3], 0 to 1."""
    url = page.evaluate("canvas => document.querySelector(canvas).toDataURL('image/png')", canvas)
    return decoded(base64.b64decode(url.split(",")[1]))


def still(page: Any) -> Picture:
    """What the canvas shows when it has stopped changing."""
    pictures = [picture(page)]

    def same() -> bool:
        page.wait_for_timeout(300)
        pictures.append(picture(page))
        return bool(np.array_equal(*pictures[-2:]))

    until(same, "the canvas is still")
    return pictures[-1]


def decoded(content: bytes) -> Picture:
    """An encoded picture, [H, W, 3], 0 to 1."""
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), np.float64) / 255


def psnr_db(a: Picture, b: Picture) -> float:
    """Likeness of two pictures of one size."""
    return float(-10 * np.log10(max(float(np.mean((a - b) ** 2)), 1e-12)))


def choose(page: Any, label: str) -> None:
    """Press one of a row of keys, which are radio buttons."""
    page.get_by_role("radio", name=label, exact=True).check()


def address(page: Any) -> str:
    """The address as it is now; `page.url` is brought up to date only while Playwright is asked for something."""
    found: str = page.evaluate("() => location.href")
    return found


def shown_version(page: Any) -> int:
    """Version of the scene on the canvas; 0 before the first."""
    canvas = page.locator(".stage canvas")
    return int(canvas.get_attribute("data-version") or 0) if canvas.count() else 0


def violations(page: Any) -> list[str]:
    """What axe finds wrong; nothing where there are no packages of Node at all, of which `test_axe_is_there` tells."""
    if not NODE_MODULES.is_dir():
        return []
    page.evaluate(AXE.read_text())
    found = page.evaluate("() => axe.run()")["violations"]
    return [f"{one['id']}: {one['help']}: {[node['html'][:200] for node in one['nodes']]}" for one in found]


def keep(page: Any, path: Path) -> None:
    """A screenshot, small enough for documentation."""
    raw = path.with_suffix(".png")
    page.screenshot(path=raw)
    Image.open(raw).convert("RGB").save(path, quality=82, method=6)
    raw.unlink()
    assert path.stat().st_size < MOST_BYTES
