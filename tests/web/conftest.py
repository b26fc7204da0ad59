"""A browser, pages in it that report what goes wrong in them, and a daemon with something to show."""

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from spiked_service.api.routes.page import PAGE

from spiked.sensor import Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.record import simulate

sys.path.append(str(Path(__file__).parent))  # pytest's importlib mode adds no folder by itself
from browsing import DESKTOP, PATIENCE_S, STEPS, Studied, finished

FLAGS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
"""WebGL without a GPU; root needs no sandbox; nothing is asked of the network."""
FRAMES = 1024


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Debian's Chromium, driven by Playwright.

    One a file: until Playwright is closed, its event loop counts as running in this thread, and tests of other files
    that call `asyncio.run` in the same process would fail.
    """
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("there is no chromium (apt-get install chromium)")
    if not (PAGE / "index.html").is_file():
        pytest.skip("the page is not built (make page)")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=chromium, args=FLAGS)
        yield started
        started.close()


Visit = Callable[..., Any]


@pytest.fixture
def visit(browser: Any) -> Iterator[Visit]:
    """Opens addresses in pages of their own: `visit(address, theme="dark", viewport=PHONE)`.

    A page that throws, breaks its content security policy or asks another machine for anything fails the test. Requests
    may fail: services go away.
    """
    opened: list[Any] = []
    faults: list[str] = []

    def on_console(message: Any) -> None:
        if (
            message.type == "error"
            and "Failed to load resource" not in message.text
            and "WebSocket" not in message.text
            and "Error creating WebGL context" not in message.text  # the page itself says so
        ):
            faults.append(message.text)

    def on_request(request: Any) -> None:
        asked = urlsplit(request.url)
        if asked.scheme in ("http", "https", "ws", "wss") and asked.hostname not in ("127.0.0.1", "localhost"):
            faults.append(f"a request leaves the machine: {request.url}")

    def go(address: str, *, theme: str = "dark", viewport: dict[str, int] = DESKTOP, touch: bool = False) -> Any:
        context = browser.new_context(viewport=viewport, color_scheme=theme, has_touch=touch, accept_downloads=True)
        opened.append(context)
        # This browser draws without graphics hardware, where the page shows points unless splats are wanted.
        context.add_init_script("try { localStorage.setItem('spiked.splats', 'always'); } catch {}")
        page = context.new_page()
        page.set_default_timeout(1000 * PATIENCE_S)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", on_console)
        page.on("request", on_request)
        page.on("websocket", on_request)
        page.goto(address)
        return page

    yield go
    for context in opened:
        for page in context.pages:
            page.unroute_all(behavior="ignoreErrors")  # a request that is answered right now would fail the next test
        context.close()
    assert faults == []


@contextmanager
def running(daemon_class: Any, folder: Path, *arguments: str) -> Iterator[Any]:
    """A daemon for more than one test."""
    folder.mkdir(exist_ok=True)
    one = daemon_class("--no-capture", *arguments, folder=folder)
    try:
        yield one
    finally:
        one.close()


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short simulated recording."""
    folder = tmp_path_factory.mktemp("web") / "room"
    simulate(SimulatedCamera(Sensor(320, 200, 20_000.0), seed=3), folder, "room", FRAMES, views=0)
    return folder / "room.dat"


@pytest.fixture(scope="session")
def studied(daemon_class: Any, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studied]:
    """A replayed recording, reconstructed, in a daemon that waits for more."""
    with running(daemon_class, room.parent / "daemon", "--device", "sim:") as daemon:
        for before in (
            {"source": f"replay:{room}?gap=700:40:usb", "name": "desk, loose cable"},
            {"source": "sim:?width=160&height=100&seed=5", "frames": 2000, "name": "hall, first try"},
        ):
            answer = daemon.http.post("captures", json={**before, "reconstruct": False})
            assert answer.status_code == 201, answer.text
            finished(daemon.http, answer.json()["id"])
        plan = {"source": f"replay:{room}", "name": "desk, by hand", "options": {"steps": STEPS}}
        answer = daemon.http.post("captures", json=plan)
        assert answer.status_code == 201, answer.text
        capture = finished(daemon.http, answer.json()["id"])
        assert capture["state"] == "complete", capture["reason"]
        yield Studied(daemon, capture)


@pytest.fixture(scope="session")
def pictures_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where screenshots go: SCREENSHOTS, or a folder that is thrown away."""
    wanted = os.environ.get("SCREENSHOTS")
    folder = Path(wanted) if wanted else tmp_path_factory.mktemp("screenshots")
    folder.mkdir(parents=True, exist_ok=True)
    return folder
