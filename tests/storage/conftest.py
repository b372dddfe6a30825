"""Real stores and databases for the tests of storage.

A test with `objects` runs with a folder and with a bucket, or only with a folder if it also uses `folder`; a test with
`engine` runs with SQLite and with PostgreSQL. The bucket is in the default run where the store itself is tested with a
few objects.
"""

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import Connection, Engine

from storage.database.engine import open_engine, writing
from storage.objects.store import Objects
from tests.parts.disks import small_disk
from tests.storage.installation import fill

DISK = 12 << 20
"""Bytes of the small disk."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "store"


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "store" in metafunc.fixturenames:
        tests_the_store = metafunc.module.__name__.startswith("tests.storage.objects.")
        quick = tests_the_store and "filled" not in metafunc.fixturenames
        bucket = pytest.param("bucket", marks=() if quick else pytest.mark.slow)
        kinds = ["folder"] if "folder" in metafunc.fixturenames else ["folder", bucket]
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


@pytest.fixture
def engine(database_url: str) -> Iterator[Engine]:
    engine = open_engine(database_url)
    yield engine
    engine.dispose()


@pytest.fixture
def digests(objects: Objects) -> Callable[[str], dict[str, str]]:
    """Returns the SHA-256 of every object below a folder of the store."""

    def of(below: str) -> dict[str, str]:
        paths = sorted(objects.paths_below(below))
        assert paths
        return {
            path.removeprefix(f"{below}/"): hashlib.sha256(objects.read(path).read()).hexdigest()
            for path in paths
        }

    return of


@pytest.fixture
def connection(engine: Engine) -> Iterator[Connection]:
    """A connection in a transaction that may write."""
    with writing(engine) as connection:
        yield connection


@pytest.fixture
def filled(engine: Engine, objects: Objects) -> Objects:
    """The store of an installation with one item of every kind; its database is `engine`."""
    fill(engine, objects)
    return objects


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A folder on a disk of `DISK` bytes."""
    with small_disk(tmp_path / "disk", DISK) as folder:
        yield folder
