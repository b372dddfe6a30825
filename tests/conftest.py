"""Parts that tests of every floor use."""

from collections.abc import Iterator

import pytest

from storage.database import open_engine
from tests import postgres

TEMPLATE = "with_tables"


@pytest.fixture(scope="session")
def postgresql_server() -> Iterator[postgres.Server]:
    """A PostgreSQL server; skipped where none can be run."""
    with postgres.server() as server, server.database(TEMPLATE) as url:
        open_engine(url).dispose()
        yield server


@pytest.fixture
def postgresql(postgresql_server: postgres.Server) -> Iterator[str]:
    """The URL of a fresh database that has the tables."""
    with postgresql_server.database(like=TEMPLATE) as url:
        yield url
