"""Links to mattes: found by their token, until they expire or are deleted."""

import pytest
from sqlalchemy import Engine, select

from storage.database.engine import reading, writing
from storage.database.owners import for_owner
from storage.database.tables import links as table
from storage.errors import Conflict, NotFound
from storage.records import links, mattes


@pytest.fixture(autouse=True)
def matte(engine: Engine) -> str:
    with writing(for_owner(engine, "alice")) as c:
        mattes.add_imported(c, "m1", {}, {})
    return "m1"


def test_link_works_until_it_is_deleted(engine: Engine, matte: str) -> None:
    with writing(for_owner(engine, "alice")) as c:
        token, row = links.create(c, matte, 60)
        other, _ = links.create(c, matte, 60)
    with reading(engine) as c:
        found = links.find(c, token)
        assert (found.id, found.matte, found.owner) == (row.id, "m1", "alice")
        assert token not in str(c.execute(select(table)).all())
        with pytest.raises(NotFound, match="expired or was deleted"):
            links.find(c, token[:-1])
        assert len(links.list_all(c, matte)) == 2
    with writing(for_owner(engine, "alice")) as c:
        with pytest.raises(NotFound, match="matte m2 has no link"):
            links.remove(c, "m2", row.id)
        links.remove(c, matte, row.id)
        with pytest.raises(NotFound, match="has no link"):
            links.remove(c, matte, row.id)
    with reading(engine) as c:
        with pytest.raises(NotFound):
            links.find(c, token)
        assert links.find(c, other).matte == matte


def test_expired_link_is_not_found_and_then_deleted(engine: Engine, matte: str) -> None:
    with writing(engine) as c:
        token, _ = links.create(c, matte, 0)
        lasting, _ = links.create(c, matte, 60)
        with pytest.raises(NotFound):
            links.find(c, token)
        assert len(links.list_all(c, matte)) == 1
        links.delete_expired(c)
        assert len(c.execute(select(table)).all()) == 1
        links.find(c, lasting)


def test_links_go_with_their_matte(engine: Engine, matte: str) -> None:
    with writing(engine) as c:
        token, _ = links.create(c, matte, 60)
        mattes.delete(c, matte)
        with pytest.raises(NotFound):
            links.find(c, token)


def test_other_owners_see_and_delete_none(engine: Engine, matte: str) -> None:
    with writing(for_owner(engine, "alice")) as c:
        _, row = links.create(c, matte, 60)
    with writing(for_owner(engine, "bob")) as c:
        assert links.list_all(c, matte) == []
        with pytest.raises(NotFound):
            links.remove(c, matte, row.id)


def test_links_to_a_matte_are_limited(engine: Engine, matte: str) -> None:
    with writing(engine) as c:
        for _ in range(links.MOST):
            links.create(c, matte, 60)
        with pytest.raises(Conflict, match="delete one first"):
            links.create(c, matte, 60)
