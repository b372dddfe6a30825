"""Opening a database without upgrading it."""

from pathlib import Path

import pytest

from storage.database.engine import open_engine
from storage.errors import Conflict
from storage.maintenance.row_dump import open_without_upgrade


def test_missing_database_is_refused_and_not_created(tmp_path: Path) -> None:
    with pytest.raises(Conflict, match=r"no database sqlite:.*none\.db; name the service's database"):
        open_without_upgrade(f"sqlite:///{tmp_path}/none.db")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "empty.db").touch()
    with pytest.raises(Conflict, match="no tables of envmatte"):
        open_without_upgrade(f"sqlite:///{tmp_path}/empty.db")
    open_engine(f"sqlite:///{tmp_path}/some.db").dispose()
    open_without_upgrade(f"sqlite:///{tmp_path}/some.db").dispose()
