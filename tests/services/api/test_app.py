"""What holds for every route of the app, whatever it does."""

from collections.abc import Iterator
from inspect import iscoroutinefunction

import pytest
from fastapi import FastAPI
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient

from services.api.app import build_app
from services.settings import Settings
from storage.database.engine import open_engine
from storage.objects.store import Objects


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FastAPI]:
    data = tmp_path_factory.mktemp("data")
    engine = open_engine(f"sqlite:///{data}/envmatte.db")
    yield build_app(Settings(data=data), engine, Objects((data / "store").as_uri()))
    engine.dispose()


@pytest.fixture(scope="module")
def routes(app: FastAPI) -> list[APIRoute]:
    routers = [one.original_router for one in app.routes if hasattr(one, "original_router")]
    return [route for router in routers for route in router.routes if isinstance(route, APIRoute)]


def test_no_route_takes_a_thread_out_of_turn(routes: list[APIRoute]) -> None:
    """FastAPI runs a plain function in one of the threads that all owners share."""
    assert len(routes) > 60
    assert [route.path for route in routes if not iscoroutinefunction(route.endpoint)] == []


def test_no_route_leaves_its_body_to_fastapi(routes: list[APIRoute]) -> None:
    """It reads a body whole, however large it is."""
    assert [route.path for route in routes if route.body_field is not None] == []


@pytest.mark.parametrize("route", ["captures", "jobs", "mattes", "mattes/m/composite", "programs", "uploads"])
def test_body_with_a_content_coding_is_refused(app: FastAPI, route: str) -> None:
    client = TestClient(app, "http://127.0.0.1")
    answer = client.post(f"/v1/{route}", content=b"{}", headers={"Content-Encoding": "gzip"})
    assert (answer.status_code, answer.headers["accept-encoding"]) == (415, "identity")
    assert answer.json()["field"] == "Content-Encoding"
    answer = client.post(f"/v1/{route}", content=b"{}", headers={"Content-Encoding": "Identity"})
    assert answer.json().get("field") != "Content-Encoding"


@pytest.mark.parametrize("kind", ["captures", "jobs", "mattes", "programs"])
def test_list_refuses_a_filter_that_it_does_not_have(app: FastAPI, kind: str) -> None:
    client = TestClient(app, "http://127.0.0.1")
    assert client.get(f"/v1/{kind}", params={"limit": 1}).json()[kind] == []
    answer = client.get(f"/v1/{kind}", params={"limit": 1, "stat": "running"})
    assert (answer.status_code, answer.json()["field"]) == (422, "stat")
    assert answer.json()["detail"].startswith("stat: this list takes after, ")


def test_head_ignores_range(app: FastAPI) -> None:
    client = TestClient(app, "http://127.0.0.1")
    whole = client.get("/docs")
    for asked in ("bytes=0-9", f"bytes={len(whole.content)}-"):
        assert client.get("/docs", headers={"Range": asked}).status_code in (206, 416)
        head = client.head("/docs", headers={"Range": asked})
        assert (head.status_code, head.headers["content-length"]) == (200, str(len(whole.content)))


def test_idempotency_keys_say_that_bodies_are_not_compared(app: FastAPI) -> None:
    operations = [one for path in app.openapi()["paths"].values() for one in path.values()]
    parameters = [one for operation in operations for one in operation.get("parameters", [])]
    keys = [one["description"] for one in parameters if one["name"].lower() == "idempotency-key"]
    assert len(keys) >= 3
    assert all("bodies are not compared" in description for description in keys)


def test_openapi_has_the_content_type_of_every_answer(app: FastAPI) -> None:
    for path, operations in app.openapi()["paths"].items():
        if "get" in operations:
            assert operations["get"]["responses"]["200"].get("content"), path
