"""`/docs/guide`: the documentation, built from `docs/` and the code, or a note how to build it."""

from pathlib import Path

from fastapi import FastAPI
from fastapi.responses import HTMLResponse, RedirectResponse
from fastapi.staticfiles import StaticFiles
from starlette.responses import Response
from starlette.routing import Mount
from starlette.types import Scope

PATH = "/docs/guide"
GUIDE = Path(__file__).parents[2] / "guide"
_UNBUILT = """<!doctype html>
<html lang="en">
<title>spiked: documentation</title>
<h1>The documentation is not built</h1>
<p>In a checkout, <code>make docs</code> builds it; then start the service again. Packages contain it.</p>
<p>Its sources are readable as they are, in the folder <code>docs</code>.
<code>spiked COMMAND --help</code> and the <a href="../">API</a> describe themselves.</p>
</html>
"""


class _Guide(StaticFiles):
    """Serves files that a browser asks for anew each time, because a new release has others under the same names."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers["Cache-Control"] = "no-cache"
        return response


def mount_guide(app: FastAPI, folder: Path = GUIDE) -> None:
    """Serve the built documentation below `PATH`, or a note how to build it. Call before the page is mounted."""

    @app.get(PATH, include_in_schema=False)
    def without_slash() -> RedirectResponse:
        """A relative redirect, which also works behind a proxy that changes the path."""
        return RedirectResponse("guide/")

    if (folder / "index.html").is_file():
        app.router.routes.append(Mount(PATH, _Guide(directory=folder, html=True)))
        return

    @app.get(f"{PATH}/{{path:path}}", include_in_schema=False)
    def unbuilt(path: str) -> HTMLResponse:
        return HTMLResponse(_UNBUILT, 404 if path else 200)
