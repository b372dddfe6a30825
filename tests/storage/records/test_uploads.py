"""Rows of uploads: offsets and parts, concurrent writers, expiry, and Idempotency-Keys."""

import threading
import time

import pytest
from sqlalchemy import Engine, select
from sqlalchemy.exc import IntegrityError

from storage.database.engine import writing
from storage.database.owners import DEFAULT, for_owner
from storage.database.tables import upload_parts
from storage.errors import Conflict, NotFound
from storage.layout.uploads import Part
from storage.records import uploads

DAY = 86400.0


def made(engine: Engine, upload: str = "u", length: int = 10, seconds: float = DAY) -> str:
    with writing(engine) as c:
        uploads.add(c, upload, length, "name YQ==", seconds, None)
    return upload


def test_upload_advances_by_recorded_parts(engine: Engine) -> None:
    made(engine)
    with writing(engine) as c:
        before = uploads.get(c, "u")
        assert (before.offset, before.length, before.metadata, before.parts) == (0, 10, "name YQ==", 0)
        assert uploads.advance(c, "u", 0, [Part("a", 3), Part("b", 4)], 2 * DAY) == 7
        assert uploads.get(c, "u").parts == 2
        assert uploads.advance(c, "u", 7, [], 2 * DAY) == 7
        after = uploads.get(c, "u")
        assert (after.offset, after.parts) == (7, 2)
        assert after.expires_at > before.expires_at + DAY / 2
        assert uploads.advance(c, "u", 7, [Part("c", 3)], DAY) == 10
        assert uploads.parts_of(c, "u") == [Part("a", 3), Part("b", 4), Part("c", 3)]


@pytest.mark.parametrize("offset", [1, 6, 8])
def test_upload_advances_only_from_its_offset(engine: Engine, offset: int) -> None:
    made(engine)
    with writing(engine) as c:
        uploads.advance(c, "u", 0, [Part("a", 7)], DAY)
    with pytest.raises(Conflict, match=f"byte 7, not {offset}") as caught, writing(engine) as c:
        uploads.advance(c, "u", offset, [Part("x", 2)], DAY)
    assert caught.value.fields == {"offset": 7}
    with engine.connect() as c:
        assert uploads.parts_of(c, "u") == [Part("a", 7)]


def test_one_of_many_writers_at_an_offset_wins(engine: Engine) -> None:
    made(engine)
    won: list[str] = []
    lost: list[str] = []

    def write(name: str) -> None:
        try:
            with writing(engine) as c:
                uploads.advance(c, "u", 0, [Part(name, 5)], DAY)
            won.append(name)
        except Conflict:
            lost.append(name)

    writers = [threading.Thread(target=write, args=(f"w{n}",)) for n in range(8)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert (len(won), len(lost)) == (1, 7)
    with engine.connect() as c:
        assert uploads.parts_of(c, "u") == [Part(won[0], 5)]


def test_deleted_upload_is_not_found(engine: Engine) -> None:
    made(engine)
    with writing(engine) as c:
        uploads.advance(c, "u", 0, [Part("a", 7)], DAY)
        assert uploads.delete(c, "u")
        assert not uploads.delete(c, "u")
        assert c.execute(select(upload_parts)).all() == []
        for call in (
            lambda: uploads.get(c, "u"),
            lambda: uploads.advance(c, "u", 7, [Part("b", 1)], DAY),
        ):
            with pytest.raises(NotFound, match="start a new upload"):
                call()


def test_expired_upload_is_not_found(engine: Engine) -> None:
    made(engine, "short", seconds=0.05)
    made(engine, "long")
    time.sleep(0.1)
    with writing(for_owner(engine, DEFAULT)) as c:
        with pytest.raises(NotFound):
            uploads.get(c, "short")
        assert uploads.delete_expired(c) == ["short"]
        assert uploads.delete_expired(c) == []
        assert uploads.get(c, "long").id == "long"


def test_key_has_at_most_one_upload(engine: Engine) -> None:
    with writing(engine) as c:
        uploads.add(c, "first", 1, "", DAY, "key")
        row = uploads.by_key(c, "key")
        assert row is not None
        assert row.id == "first"
        assert uploads.by_key(c, "another") is None
    with pytest.raises(IntegrityError), writing(engine) as c:
        uploads.add(c, "second", 1, "", DAY, "key")
    with writing(engine) as c:
        uploads.delete(c, "first")
        uploads.add(c, "second", 1, "", DAY, "key")
