"""Parts that tests of every floor use."""

from collections.abc import Iterator

import pytest

from storage.database import open_engine
from tests import postgres
from tests.s3 import s3, s3_server

__all__ = ["postgresql", "postgresql_server", "s3", "s3_server"]


@pytest.fixture(scope="session")
def postgresql_server() -> Iterator[postgres.Server]:
    """A PostgreSQL server; skipped where none can be run."""
    with postgres.server() as server, server.database(postgres.TEMPLATE) as url:
        open_engine(url).dispose()
        yield server


@pytest.fixture
def postgresql(postgresql_server: postgres.Server) -> Iterator[str]:
    """The URL of a fresh database that has the tables."""
    with postgresql_server.database(like=postgres.TEMPLATE) as url:
        yield url
