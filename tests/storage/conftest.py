"""A store in a folder and databases of both engines, all real, for the tests of storage."""

import hashlib
import shutil
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
def digests(folder: Path) -> Callable[[str], dict[str, str]]:
    """The files below a folder of the store, each with the hash of its bytes."""

    def of(below: str) -> dict[str, str]:
        root = folder / below
        files = [path for path in sorted(root.rglob("*")) if path.is_file()]
        assert files
        return {str(f.relative_to(root)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}

    return of
