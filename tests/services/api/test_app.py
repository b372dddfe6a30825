"""What holds for every route of the app, whatever it does."""

from inspect import iscoroutinefunction

import pytest
from fastapi.routing import APIRoute

from services.api.app import build_app
from services.settings import Settings
from storage.database.engine import open_engine
from storage.objects.store import Objects


@pytest.fixture(scope="module")
def routes(tmp_path_factory: pytest.TempPathFactory) -> list[APIRoute]:
    data = tmp_path_factory.mktemp("data")
    engine = open_engine(f"sqlite:///{data}/envmatte.db")
    app = build_app(Settings(data=data), engine, Objects((data / "store").as_uri()))
    engine.dispose()
    routers = [one.original_router for one in app.routes if hasattr(one, "original_router")]
    return [route for router in routers for route in router.routes if isinstance(route, APIRoute)]


def test_no_route_takes_a_thread_out_of_turn(routes: list[APIRoute]) -> None:
    """FastAPI runs a plain function in one of the threads that all owners share."""
    assert len(routes) > 60
    assert [route.path for route in routes if not iscoroutinefunction(route.endpoint)] == []


def test_no_route_leaves_its_body_to_fastapi(routes: list[APIRoute]) -> None:
    """It reads a body whole, however large it is."""
    assert [route.path for route in routes if route.body_field is not None] == []
