"""A database and a store of their own for the tests of services."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine

from storage.database.engine import open_engine
from storage.objects.store import Objects


@pytest.fixture
def engine(sqlite: str) -> Iterator[Engine]:
    engine = open_engine(sqlite)
    yield engine
    engine.dispose()


@pytest.fixture
def objects(tmp_path: Path) -> Objects:
    return Objects((tmp_path / "store").as_uri())
