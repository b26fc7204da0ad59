"""The documentation site: complete references, strict links, nothing from elsewhere, a search that works from disk."""

import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from html import unescape
from pathlib import Path
from typing import Any

import pytest
import typer
import uvicorn
from fastapi import FastAPI
from fastapi.testclient import TestClient
from spiked_driver.source_kinds import KINDS
from spiked_service.api.auth.security import HEADERS
from spiked_service.api.routes.guide import mount_guide
from spiked_service.cli.main import app
from spiked_service.daemon import api_document
from spiked_service.settings.settings import Settings

from .test_public_api import modules

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    pytest.importorskip("mkdocs", reason="mkdocs is not installed (make docs)")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", folder]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def serving() -> Iterator[Callable[[FastAPI], str]]:
    """Serves an application on a free port of this machine, until the end of the test; gives its address."""
    started: list[tuple[uvicorn.Server, threading.Thread]] = []

    def serve(service: FastAPI) -> str:
        server = uvicorn.Server(uvicorn.Config(service, host="127.0.0.1", port=0, log_level="error"))
        thread = threading.Thread(target=server.run)
        thread.start()
        started.append((server, thread))
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.01)
        return f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"

    yield serve
    for server, thread in started:
        server.should_exit = True
        thread.join()


def text_of(page: Path) -> str:
    """What a page says, without its tags."""
    return unescape(re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8")))


def leaves(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command and group below a command."""
    for name, one in getattr(command, "commands", {}).items():
        yield (*words, name), one
        yield from leaves(one, (*words, name))


def test_every_command_has_a_page_with_all_its_options(site: Path) -> None:
    found = list(leaves(typer.main.get_command(app)))
    assert {("serve",), ("token", "create")} <= {words for words, _ in found}
    for words, command in found:
        said = text_of(site / "reference/commands" / f"{'-'.join(words)}.html")
        options = [name for one in command.params for name in (*one.opts, *one.secondary_opts) if name[0] == "-"]
        assert [name for name in options if name not in said] == [], words
        meanings = [re.split(r"[`<|]", one.help or "")[0] for one in command.params]
        assert [meaning for meaning in meanings if " ".join(meaning.split()) not in said] == [], words


def test_every_operation_of_the_api_has_an_entry_with_its_parameters(site: Path) -> None:
    document = api_document()
    pages = "".join(text_of(site / "reference/rest" / f"{tag['name']}.html") for tag in document["tags"])
    listed = text_of(site / "reference/rest/index.html")
    for path, item in document["paths"].items():
        for method, operation in item.items():
            assert f"{method.upper()} {path}" in pages and f"{method.upper()} {path}" in listed
            assert [one["name"] for one in operation.get("parameters", []) if one["name"] not in pages] == []
    models = (site / "reference/rest/models.html").read_text(encoding="utf-8")
    assert [name for name in document["components"]["schemas"] if f'id="{name}"' not in models] == []


def test_every_setting_and_every_option_of_a_source_has_an_entry(site: Path) -> None:
    settings = (site / "reference/settings.html").read_text(encoding="utf-8")
    assert [name for name in Settings.model_fields if f'id="{name}"' not in settings] == []
    assert [name for name in Settings.model_fields if f"SPIKED_{name.upper()}" not in settings] == []
    sources = text_of(site / "reference/sources.html")
    assert [name for kind in KINDS for name in kind.options.model_fields if name not in sources] == []


def test_every_public_module_has_a_page(site: Path) -> None:
    assert [name for name in modules() if not (site / "reference" / f"{name}.html").is_file()] == []
    assert 'id="spiked.scene.Scene.write_ply"' in (site / "reference/spiked.scene.html").read_text(encoding="utf-8")
    assert "spiked reconstruct" in (site / "index.html").read_text(encoding="utf-8")


def test_pages_obey_the_policy_of_the_daemon(site: Path) -> None:
    """Neither scripts nor styles inside a page, and nothing from another server."""
    policy = HEADERS["content-security-policy"]
    assert "script-src 'self'" in policy and "style-src 'self'" in policy
    for page in site.rglob("*.html"):
        html = page.read_text(encoding="utf-8")
        tags = re.findall(r"<(?:script|style|link|img|iframe)\b[^>]*>", html)
        assert [tag for tag in tags if re.search(r"""(?:src|href)=["'](?:https?:)?//""", tag)] == [], page
        inline = [tag for tag in tags if tag.startswith("<script") and "src=" not in tag and "json" not in tag]
        assert inline == [] and "<style" not in html and not re.search(r"<[^>]+ (?:style|on\w+)=", html), page
        scripts = re.findall(r'<script src="([^"]+)"', html)
        assert [name for name in scripts if not (page.parent / name).is_file()] == [], page


def found_by_search(address: str, word: str) -> tuple[list[str], list[str]]:
    """Addresses that the search of the site at an address finds, and what the browser complained about."""
    sync = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("needs chromium")
    wrong: list[str] = []
    with sync.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page()
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.on("requestfailed", lambda request: wrong.append(request.url))
        page.goto(address)
        page.locator("input.md-search__input").click()
        page.keyboard.type(word)
        page.locator(".md-search-result__item").first.wait_for()
        links = page.locator(".md-search-result__link").all()
        found = [link.get_attribute("href").removeprefix(address.rsplit("/", 1)[0] + "/") for link in links]
        browser.close()
    return found, wrong


def test_the_search_works_from_disk(site: Path) -> None:
    found, wrong = found_by_search((site / "reference/index.html").as_uri(), "limit_renders")
    assert any(one.endswith("settings.html?h=limit_renders#limit_renders") for one in found) and wrong == []


def test_the_search_works_on_the_daemon(site: Path, serving: Callable[[FastAPI], str]) -> None:
    service = FastAPI()

    @service.middleware("http")
    async def with_headers(request: Any, call_next: Any) -> Any:
        response = await call_next(request)
        response.headers.update(HEADERS)
        return response

    mount_guide(service, site)
    found, wrong = found_by_search(f"{serving(service)}/docs/guide/", "limit_renders")
    assert any(one.endswith("settings.html?h=limit_renders#limit_renders") for one in found) and wrong == []


def test_the_daemon_serves_the_guide_and_nothing_beside_it(tmp_path: Path) -> None:
    guide = tmp_path / "guide"
    (guide / "reference").mkdir(parents=True)
    (guide / "index.html").write_text("<title>guide</title>")
    (guide / "reference/index.html").write_text("<title>reference</title>")
    (tmp_path / "secret.txt").write_text("secret")
    (guide / "link.txt").symlink_to(tmp_path / "secret.txt")
    service = FastAPI()
    mount_guide(service, guide)
    http = TestClient(service)
    assert http.get("/docs/guide").url.path == "/docs/guide/"
    assert (http.get("/docs/guide/").text, http.get("/docs/guide/").headers["cache-control"]) == (
        "<title>guide</title>",
        "no-cache",
    )
    assert http.get("/docs/guide/reference/").text == "<title>reference</title>"
    for path in ("../secret.txt", "%2e%2e/secret.txt", "reference/..%2f..%2fsecret.txt", "//etc/passwd", "link.txt"):
        answer = http.get(f"/docs/guide/{path}")
        assert answer.status_code == 404 and "secret" not in answer.text, path


def test_without_a_built_guide_the_daemon_says_how_to_build_it(tmp_path: Path) -> None:
    service = FastAPI()
    mount_guide(service, tmp_path / "none")
    http = TestClient(service)
    assert http.get("/docs/guide").status_code == 200 and "make docs" in http.get("/docs/guide/").text
    assert http.get("/docs/guide/method.html").status_code == 404
