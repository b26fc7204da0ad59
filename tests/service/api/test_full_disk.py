"""A disk that is full is an answer that says so, and what was there stays."""

import errno

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from spiked_service.api.problems import install


def app_that_meets(error: OSError) -> TestClient:
    app = FastAPI()
    install(app)

    @app.post("/scale")
    def write() -> None:
        raise error

    return TestClient(app, raise_server_exceptions=False)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_507(number: int) -> None:
    answer = app_that_meets(OSError(number, "full")).post("/scale")
    assert answer.status_code == 507 and "free disk space" in answer.json()["detail"]


def test_other_errors_of_the_system_are_unexpected() -> None:
    assert app_that_meets(OSError(errno.EIO, "broken")).post("/scale").status_code == 500
