"""API keys: created, found by hash, revoked."""

import pytest
from sqlalchemy import Engine, select

from storage.database.engine import reading, writing
from storage.database.tables import keys as table
from storage.errors import Conflict, InvalidInput, NotFound
from storage.records import api_keys


def test_key_works_until_revoked(engine: Engine) -> None:
    with reading(engine) as c:
        assert not api_keys.any_created(c)
    with writing(engine) as c:
        first, second = api_keys.create(c, "lab", "alice", "write"), api_keys.create(c, "shop", "bob", "read")
    assert first != second
    with reading(engine) as c:
        row = api_keys.find(c, first)
        assert row is not None
        assert (row.name, row.owner, row.scope, row.revoked_at) == ("lab", "alice", "write", None)
        assert api_keys.find(c, first[:-1]) is None
        assert api_keys.find(c, "\udce4\udcff") is None
    with writing(engine) as c:
        api_keys.revoke(c, "lab")
    with writing(engine) as c:
        assert api_keys.find(c, first) is None
        assert api_keys.find(c, second) is not None
        with pytest.raises(NotFound, match="lab"):
            api_keys.revoke(c, "lab")
        api_keys.revoke(c, "shop")
        assert api_keys.any_created(c)  # otherwise the service would be open again
        assert api_keys.create(c, "lab", "alice", "read") != first
        assert [(row.name, row.revoked_at is None) for row in api_keys.list_all(c)] == [
            ("lab", False),
            ("shop", False),
            ("lab", True),
        ]


def test_stored_row_does_not_reveal_key(engine: Engine) -> None:
    with writing(engine) as c:
        key = api_keys.create(c, "lab", "alice", "write")
        (row,) = c.execute(select(table)).all()
    assert len(key.removeprefix(api_keys.PREFIX)) == 43  # 256 bits in Base64
    assert key.removeprefix(api_keys.PREFIX) not in str(row)


def test_active_key_names_are_unique(engine: Engine) -> None:
    with writing(engine) as c:
        api_keys.create(c, "lab", "alice", "write")
        with pytest.raises(Conflict, match="revoke it first"):
            api_keys.create(c, "lab", "bob", "read")


@pytest.mark.parametrize(
    ("name", "owner"), [("", "alice"), ("lab", ""), ("lab", "x" * 65), (" lab", "a"), ("lab", "a\nb")]
)
def test_invalid_names_are_refused(engine: Engine, name: str, owner: str) -> None:
    with writing(engine) as c, pytest.raises(InvalidInput, match="1 to 64 characters"):
        api_keys.create(c, name, owner, "read")
