"""`/docs`: the API for people, drawn from openapi.json by a page of our own that needs no other host."""

from pathlib import Path

from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles

DOCS = Path(__file__).parents[1] / "docs"


def mount_docs(app: FastAPI) -> None:
    """Serve it, before the page that is mounted at `/`."""
    app.mount("/docs", StaticFiles(directory=DOCS, html=True), name="docs")
