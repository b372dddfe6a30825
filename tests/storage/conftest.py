"""A store in a folder and databases of both engines, all real, for the tests of storage."""

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine

from storage.database import open_engine
from storage.objects import Objects


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "store"


@pytest.fixture
def objects(folder: Path) -> Objects:
    return Objects(folder.as_uri())


@pytest.fixture
def sqlite(tmp_path: Path) -> str:
    """The URL of a SQLite database that is not there yet."""
    return f"sqlite:///{tmp_path}/ledger.db"


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
def digests(folder: Path) -> Callable[[str], dict[str, str]]:
    """The files below a folder of the store, each with the hash of its bytes."""

    def of(below: str) -> dict[str, str]:
        root = folder / below
        files = [path for path in sorted(root.rglob("*")) if path.is_file()]
        assert files
        return {str(f.relative_to(root)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}

    return of
