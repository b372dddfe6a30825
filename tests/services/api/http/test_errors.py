"""Errors as answers: headers that a status needs besides the problem detail."""

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from services.api.http.errors import register
from services.runtime.problems import Unauthorized
from storage.errors import EnvmatteError, NotFound, Unavailable


@pytest.mark.parametrize(
    ("error", "status", "header"),
    [
        (Unavailable("the database can't be reached"), 503, ("retry-after", "2")),
        (Unauthorized("a key is needed"), 401, ("www-authenticate", "Bearer")),
        (NotFound("there is none"), 404, None),
    ],
)
def test_error_is_answered_with_the_header_of_its_status(
    error: EnvmatteError, status: int, header: tuple[str, str] | None
) -> None:
    app = FastAPI()
    register(app)

    @app.get("/")
    def fail() -> None:
        raise error

    with TestClient(app) as client:
        response = client.get("/")
    assert (response.status_code, response.json()["detail"]) == (status, error.detail)
    extra = set(response.headers.items()) - {("content-type", "application/problem+json")}
    assert {(name, value) for name, value in extra if name != "content-length"} == (
        {header} if header else set()
    )
