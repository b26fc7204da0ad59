"""The built page as files, and what is said where there is none."""

from pathlib import Path

from fastapi import FastAPI
from fastapi.testclient import TestClient
from spiked_service.api.routes.page import mount_page


def client(folder: Path) -> TestClient:
    app = FastAPI()
    mount_page(app, folder)
    return TestClient(app)


def test_hashed_files_are_kept_and_the_index_is_asked_for_anew(tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / "index.html").write_text("<title>spiked</title>")
    (tmp_path / "assets" / "index-abc123.js").write_text("1")
    http = client(tmp_path)
    index = http.get("/?page=scene")
    assert (index.text, index.headers["cache-control"]) == ("<title>spiked</title>", "no-cache")
    assert "immutable" in http.get("/assets/index-abc123.js").headers["cache-control"]
    assert http.get("/assets/gone.js").status_code == 404


def test_below_the_page_a_wrong_method_of_the_api_is_told_as_one(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("<title>spiked</title>")
    app = FastAPI()
    app.add_api_route("/api/v1/captures", lambda: None, methods=["POST"])
    mount_page(app, tmp_path)
    http = TestClient(app)
    assert http.get("/api/v1/captures").status_code == 405
    assert http.get("/api/v1/nothing").status_code == 404


def test_without_a_built_page_the_service_says_how_to_build_it(tmp_path: Path) -> None:
    http = client(tmp_path)
    assert "make page" in http.get("/").text
    assert "make page" in http.get("/docs/").text
    assert http.get("/assets/index.js").status_code == 404
