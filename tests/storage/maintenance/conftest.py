"""An empty installation and a place for a backup."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine

from storage.database import dialects
from storage.maintenance import verify
from storage.objects.store import Objects


@pytest.fixture(autouse=True)
def recheck_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Verification checks its findings again without waiting."""
    monkeypatch.setattr(verify, "RECHECK_AFTER", 0.0)


@pytest.fixture
def target(tmp_path: Path) -> Objects:
    """An empty folder for a backup."""
    return Objects((tmp_path / "backup").as_uri())


@pytest.fixture
def elsewhere(tmp_path: Path) -> Iterator[tuple[Engine, Objects]]:
    """The database and the store of an empty installation."""
    engine = dialects.make_engine(f"sqlite:///{tmp_path}/elsewhere.db")
    yield engine, Objects((tmp_path / "elsewhere").as_uri())
    engine.dispose()
