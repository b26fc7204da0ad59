"""The web page: files built from `web/`, or a note how to build them."""

from pathlib import Path

from fastapi import FastAPI
from fastapi.responses import HTMLResponse
from fastapi.staticfiles import StaticFiles
from starlette.responses import Response
from starlette.routing import Match, Mount
from starlette.types import Scope

PAGE = Path(__file__).parents[2] / "page"
_UNBUILT = """<!doctype html>
<html lang="en">
<title>spiked</title>
<h1>spiked is running; its page is not built</h1>
<p>In a checkout, <code>make page</code> builds it (with Node 20 or newer, and npm); then load this address again.
Wheels contain it.</p>
<p>Everything else works without: <a href="/openapi.json">API</a>, <a href="/healthz">health</a>.</p>
</html>
"""


class _Page(StaticFiles):
    """Serves files with a hash in their name as immutable; the index is revalidated at each request."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        forever = path.startswith("assets/") and response.status_code == 200
        response.headers["Cache-Control"] = "public, max-age=31536000, immutable" if forever else "no-cache"
        return response


class _BesideApi(Mount):
    """Does not match paths of the API, so that a wrong method there is 405 rather than a missing file."""

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        if scope["path"].startswith("/api/"):
            return Match.NONE, {}
        return super().matches(scope)


def mount_page(app: FastAPI, folder: Path = PAGE) -> None:
    """Serve the built page below `/`, after all other routes; if it is not built, a note at `/` how to build it."""
    if (folder / "index.html").is_file():
        app.router.routes.append(_BesideApi("/", _Page(directory=folder, html=True)))
        return

    @app.get("/", include_in_schema=False)
    @app.get("/docs/", include_in_schema=False)
    def unbuilt() -> HTMLResponse:
        return HTMLResponse(_UNBUILT)
