"""The app of a service without a coordinator, so that jobs stay queued, for the tests of the API."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI
from sqlalchemy import Engine

from services.api.app import build_app
from services.settings import Settings
from storage.objects.store import Objects


@pytest.fixture
def build(engine: Engine, objects: Objects, tmp_path: Path) -> Iterator[Callable[..., FastAPI]]:
    """Builds the app with some settings."""
    apps: list[FastAPI] = []

    def build(**settings: object) -> FastAPI:
        apps.append(build_app(Settings(data=tmp_path, **settings), engine, objects))
        return apps[-1]

    yield build
    for app in apps:
        app.state.context.decoders.close()
