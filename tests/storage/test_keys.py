"""Keys: made once, kept as a hash, revoked for good."""

import pytest
from sqlalchemy import Engine, select

from storage import keys
from storage.database import keys as table
from storage.database import reading, writing
from storage.errors import Conflict, InvalidInput, NotFound


def test_a_key_is_known_until_it_is_revoked(engine: Engine) -> None:
    with reading(engine) as c:
        assert not keys.any_was_made(c)
    with writing(engine) as c:
        first, second = keys.make(c, "lab", "alice", "write"), keys.make(c, "shop", "bob", "read")
    assert first != second
    with reading(engine) as c:
        row = keys.known(c, first)
        assert row is not None
        assert (row.name, row.owner, row.scope, row.revoked_at) == ("lab", "alice", "write", None)
        assert keys.known(c, first[:-1]) is None
        assert keys.known(c, "\udce4\udcff") is None
    with writing(engine) as c:
        keys.revoke(c, "lab")
    with writing(engine) as c:
        assert keys.known(c, first) is None
        assert keys.known(c, second) is not None
        with pytest.raises(NotFound, match="lab"):
            keys.revoke(c, "lab")
        keys.revoke(c, "shop")
        assert keys.any_was_made(c)  # or the service would be open again
        assert keys.make(c, "lab", "alice", "read") != first
        assert [(row.name, row.revoked_at is None) for row in keys.listed(c)] == [
            ("lab", False),
            ("shop", False),
            ("lab", True),
        ]


def test_nothing_that_is_kept_tells_the_key(engine: Engine) -> None:
    with writing(engine) as c:
        key = keys.make(c, "lab", "alice", "write")
        (row,) = c.execute(select(table)).all()
    assert len(key.removeprefix(keys.PREFIX)) == 43  # 256 bits in Base64
    assert key.removeprefix(keys.PREFIX) not in str(row)


def test_a_name_is_used_once_at_a_time(engine: Engine) -> None:
    with writing(engine) as c:
        keys.make(c, "lab", "alice", "write")
        with pytest.raises(Conflict, match="revoke it first"):
            keys.make(c, "lab", "bob", "read")


@pytest.mark.parametrize(
    ("name", "owner"), [("", "alice"), ("lab", ""), ("lab", "x" * 65), (" lab", "a"), ("lab", "a\nb")]
)
def test_names_that_cannot_be_shown_are_refused(engine: Engine, name: str, owner: str) -> None:
    with writing(engine) as c, pytest.raises(InvalidInput, match="1 to 64 characters"):
        keys.make(c, name, owner, "read")
