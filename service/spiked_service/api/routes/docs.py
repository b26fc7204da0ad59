"""`/docs`: Swagger UI, built from `web/docs` and served with the page."""

from fastapi import FastAPI
from fastapi.responses import RedirectResponse


def mount_docs(app: FastAPI) -> None:
    """Redirect `/docs` to the folder of the built page. Call before the page is mounted at `/`."""

    @app.get("/docs", include_in_schema=False)
    def without_slash() -> RedirectResponse:
        """A relative redirect, which also works behind a proxy that changes the path."""
        return RedirectResponse("docs/")
