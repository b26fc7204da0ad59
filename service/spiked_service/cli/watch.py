"""The progress page of an offline reconstruction: `spiked reconstruct --watch`."""

import json
import socket
import threading
import time
from pathlib import Path

import numpy as np
import uvicorn
from fastapi import FastAPI, Response
from fastapi.staticfiles import StaticFiles

from spiked.errors import ConfigurationError
from spiked.recon import Reconstructor, Status
from spiked_service.results.image_encoding import ImageFormat, encode

_FILES = Path(__file__).with_name("watching")
_PICTURE_S = 1.0
"""Least time between two pictures, seconds."""
_PATH_POINTS = 400
"""Most points of the path that is drawn."""
_CURVE_POINTS = 300
"""Points of the loss that are kept at least."""


class Watch:
    """Serves the state given to the last `show`. Requests only copy bytes, so a browser never delays the work."""

    def __init__(self, title: str, port: int) -> None:
        """Raises ConfigurationError if the port is in use."""
        try:
            self._listener = socket.create_server(("127.0.0.1", port))
        except OSError as error:
            raise ConfigurationError(
                f"--watch cannot listen at port {port}: {error.strerror}; another program, perhaps `spiked serve`, "
                "uses it: give another with --watch-port, or 0 for a free one"
            ) from error
        self._title = title
        self._state = json.dumps({"title": title, "stage": "waiting"}).encode()
        self._pictures: dict[str, bytes] = {}
        self._curve: list[tuple[float, float]] = []
        self._begin = time.monotonic()
        self._drawn = -np.inf
        self._number = 0
        config = uvicorn.Config(self._app(), log_level="error", lifespan="off", timeout_graceful_shutdown=1)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([self._listener],), name="watch", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://127.0.0.1:{self._listener.getsockname()[1]}/"

    def show(self, reconstructor: Reconstructor, status: Status) -> None:
        """Update the page; the pictures at most once a second, because each costs a render."""
        now = time.monotonic()
        if status.loss is not None:
            self._curve.append((round(now - self._begin, 2), round(float(-10 * np.log10(status.loss)), 3)))
            if len(self._curve) > 2 * _CURVE_POINTS:
                self._curve = self._curve[::2]
        if now - self._drawn < _PICTURE_S and status.stage != "done":
            return
        self._drawn = now
        self._draw(reconstructor)
        path = reconstructor.trajectory()
        rows = np.linspace(0, max(len(path) - 1, 0), min(_PATH_POINTS, len(path))).astype(int)
        self._state = json.dumps(
            {
                "title": self._title,
                "stage": status.stage,
                "state": str(status.state),
                "reason": status.reason,
                "frames": status.frames,
                "splats": status.splats,
                "progress": round(status.progress, 4),
                "seconds": round(now - self._begin, 1),
                "poses": len(path),
                "path": np.round(path.centres[rows], 4).tolist(),
                "curve": self._curve,
                "picture": self._number,
            }
        ).encode()

    def _draw(self, reconstructor: Reconstructor) -> None:
        samples = reconstructor.samples(3)
        if not samples or samples[0].rendered is None:
            return
        middle, white = samples[len(samples) // 2], reconstructor.white
        assert middle.rendered is not None, "all are rendered, or none is"
        signed = np.clip(0.5 * white + 2 * (middle.rendered - middle.observed), 0, white)
        for name, image in (("observed", middle.observed), ("rendered", middle.rendered), ("difference", signed)):
            self._pictures[name] = encode(image, ImageFormat.PNG, white)
        self._number += 1

    def close(self) -> None:
        """Stop serving."""
        self._server.should_exit = True
        self._thread.join(3)
        self._listener.close()

    def _app(self) -> FastAPI:
        app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

        @app.get("/state.json")
        async def state() -> Response:
            return Response(self._state, media_type="application/json", headers={"Cache-Control": "no-store"})

        @app.get("/{name}.png")
        async def picture(name: str) -> Response:
            content = self._pictures.get(name)
            if content is None:
                return Response(status_code=404)
            return Response(content, media_type="image/png", headers={"Cache-Control": "no-store"})

        app.mount("/", StaticFiles(directory=_FILES, html=True))
        return app
