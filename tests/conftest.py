"""Parts that tests of every floor use."""

import signal
from collections.abc import Iterator

import pytest

from storage.database.engine import open_engine
from tests.parts import postgres
from tests.parts.s3 import s3, s3_server

AT_LENGTH = 3
"""What `--times` is from which on tests at length are run too."""
__all__ = ["postgresql", "postgresql_server", "s3", "s3_server"]


def pytest_configure() -> None:
    """Handle SIGINT even where a shell started pytest in the background: its jobs, and all they start, ignore it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--times", type=int, default=1, help="How often each fault is injected.")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is long, before anything is set up for it."""
    if config.getoption("--times") < AT_LENGTH:
        why = f"it takes a minute, or does more of what another test does: run with --times {AT_LENGTH} and more"
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker(pytest.mark.skip(reason=why))


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
