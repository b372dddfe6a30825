"""A store in a folder and a SQLite database, both real, for the tests of storage."""

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
def engine(tmp_path: Path) -> Iterator[Engine]:
    engine = open_engine(f"sqlite:///{tmp_path}/ledger.db")
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
