"""A store and a database, both real, for the tests of storage.

A test of `objects` runs twice, with a folder and with a bucket, one that looks into the folder once; a test of `engine`
runs with SQLite and with PostgreSQL.
"""

import hashlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine

from storage.database.engine import open_engine
from storage.objects.store import Objects


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "store"


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "store" in metafunc.fixturenames:
        kinds = ["folder"] if "folder" in metafunc.fixturenames else ["folder", "bucket"]
        metafunc.parametrize("store", kinds, indirect=True)


@pytest.fixture
def store(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of an empty store."""
    if request.param == "folder":
        return (tmp_path / "store").as_uri()
    url: str = request.getfixturevalue("s3")
    return url


@pytest.fixture
def objects(store: str) -> Objects:
    return Objects(store)


@pytest.fixture(scope="session")
def sqlite_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SQLite database that has the tables, for fresh ones to be copied from."""
    path = tmp_path_factory.mktemp("sqlite") / "with_tables.db"
    open_engine(f"sqlite:///{path}").dispose()
    return path


@pytest.fixture
def sqlite(tmp_path: Path, sqlite_template: Path) -> str:
    """The URL of a fresh SQLite database that has the tables."""
    path = tmp_path / "ledger.db"
    shutil.copyfile(sqlite_template, path)
    return f"sqlite:///{path}"


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest) -> str:
    """The URL of a fresh database, of each engine in turn."""
    url: str = request.getfixturevalue(request.param)
    return url


@pytest.fixture
def engine(url: str) -> Iterator[Engine]:
    engine = open_engine(url)
    yield engine
    engine.dispose()


@pytest.fixture
def digests(objects: Objects) -> Callable[[str], dict[str, str]]:
    """The objects below a folder of the store, each with the hash of its bytes."""

    def of(below: str) -> dict[str, str]:
        paths = sorted(objects.paths_below(below))
        assert paths
        return {
            path.removeprefix(f"{below}/"): hashlib.sha256(objects.read(path).read()).hexdigest()
            for path in paths
        }

    return of
