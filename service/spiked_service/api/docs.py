"""`/docs`: the API for people, drawn from openapi.json by a page of our own that needs no other host."""

from pathlib import Path

from fastapi import FastAPI
from fastapi.responses import RedirectResponse
from fastapi.staticfiles import StaticFiles

DOCS = Path(__file__).parents[1] / "docs"


def mount_docs(app: FastAPI) -> None:
    """Serve it, before the page that is mounted at `/`."""

    @app.get("/docs", include_in_schema=False)
    def without_slash() -> RedirectResponse:
        """Relative, for a proxy may have moved it. Starlette's own redirection loses to the page mounted at `/`."""
        return RedirectResponse("docs/")

    app.mount("/docs", StaticFiles(directory=DOCS, html=True), name="docs")
