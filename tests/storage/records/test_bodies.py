"""Rows of bodies: one writer for each upload, and room that counts while it is reserved."""

import time

import pytest
from sqlalchemy import Engine, update

from storage.database.engine import reading, writing
from storage.database.owners import for_owner
from storage.database.rows import ROW
from storage.database.tables import bodies as table
from storage.database.tables import uploads as uploads_table
from storage.errors import Conflict
from storage.layout.uploads import Part
from storage.records import bodies, uploads
from storage.records.bodies import LAPSE, PATIENCE, RENEW
from storage.statistics import PART, PROMISE, coming_bytes, promised_bytes, stored_bytes


def made(engine: Engine, upload: str = "u", length: int = 100) -> None:
    with writing(engine) as c:
        uploads.add(c, upload, length, "", 1e6, None)


def test_upload_has_one_writer(engine: Engine) -> None:
    made(engine)
    with writing(engine) as c:
        assert bodies.claim(c, "first", "u", 100)
        assert not bodies.claim(c, "second", "u", 100)
        assert not bodies.is_wanted(c, "first")
        bodies.ask_for(c, "u")
        assert bodies.is_wanted(c, "first")
        c.execute(update(table).values(wanted_at=table.c.wanted_at - PATIENCE))
        assert not bodies.is_wanted(c, "first")  # the other has given up
        assert not bodies.claim(c, "second", "u", 100)  # until the first has ended
        bodies.release(c, "first")
        assert bodies.claim(c, "second", "u", 100)
        bodies.renew(c, "second", 0)
        uploads.delete(c, "u")
        with pytest.raises(Conflict):
            bodies.is_wanted(c, "second")


@pytest.mark.parametrize("hours", [-1, 1])
def test_upload_survives_that_the_clock_jumps(engine: Engine, hours: float) -> None:
    made(engine)
    with writing(engine) as c:
        assert bodies.claim(c, "first", "u", 100)
        c.execute(update(table).values(renewed_at=time.time() - hours * 3600))
        bodies.delete_lapsed(c)
        assert not bodies.has_writer(c, "u")  # else nobody could write for an hour if the writer has died
        bodies.renew(c, "first", 0)
        assert bodies.has_writer(c, "u")


def test_bytes_of_an_upload_count_once_while_they_come(engine: Engine) -> None:
    made(engine)
    with writing(engine) as c:
        assert (stored_bytes(c), promised_bytes(c)) == (ROW + 100, 100)
        bodies.claim(c, "b", "u", 60)
        assert (stored_bytes(c), promised_bytes(c), coming_bytes(c)) == (ROW + 100, 40, 60)
        bodies.renew(c, "b", 50, more=20)
        assert (stored_bytes(c), promised_bytes(c), coming_bytes(c)) == (ROW + 100, 20, 30)
        bodies.record(c, "b", 80)
        uploads.advance(c, "u", 0, [Part("a", 80)], 1e6)
        assert (stored_bytes(c), promised_bytes(c), coming_bytes(c)) == (ROW + PART + 100, 20, 0)


def test_what_is_reserved_counts_for_its_owner_and_lapses(engine: Engine) -> None:
    made(engine)
    bob = for_owner(engine, "bob")
    with writing(bob) as c:
        bodies.add(c, "whole", 1000, 1500)
        assert (stored_bytes(c), promised_bytes(c), coming_bytes(c)) == (1500, 500, 1000)
        bodies.renew(c, "whole", 900, more=700)
        assert (stored_bytes(c), promised_bytes(c), coming_bytes(c)) == (1700, 0, 800)
        assert stored_bytes(c, all_owners=True) == 1700 + ROW + 100
    with writing(engine) as c:
        c.execute(update(table).values(renewed_at=time.time() - LAPSE - 1))
        assert stored_bytes(c) == ROW + 100
        bodies.renew(c, "whole", 900)  # its process was only cut off
        assert stored_bytes(c) == ROW + 100 + 1700
        bodies.delete_lapsed(c, 0)
        with pytest.raises(Conflict):
            bodies.renew(c, "whole", 900)


def test_writer_that_died_is_replaced(engine: Engine) -> None:
    made(engine)
    with writing(engine) as c:
        bodies.claim(c, "dead", "u", 10)
        c.execute(update(table).values(renewed_at=time.time() - LAPSE - 1))
        assert bodies.claim(c, "next", "u", 10)
        with pytest.raises(Conflict):
            bodies.renew(c, "dead", 10)


def test_upload_does_not_expire_while_it_is_written(engine: Engine) -> None:
    made(engine)

    def expire() -> list[str]:
        c.execute(update(uploads_table).values(expires_at=uploads_table.c.expires_at - RENEW))
        return uploads.delete_expired(c)

    with writing(engine) as c:
        c.execute(update(uploads_table).values(expires_at=time.time() + 1))
        bodies.claim(c, "b", "u", 60)
        assert expire() == []
        bodies.renew(c, "b", 50)
        assert [expire() for _ in range(4)] == [[], [], ["u"], []]
    made(engine)
    with writing(engine) as c:
        before = uploads.get(c, "u").expires_at
        bodies.claim(c, "b", "u", 60)
        assert uploads.get(c, "u").expires_at == before


@pytest.mark.parametrize("ahead", [-100, 100])
def test_clocks_of_hosts_may_differ(engine: Engine, monkeypatch: pytest.MonkeyPatch, ahead: float) -> None:
    made(engine)
    with writing(engine) as c:
        c.execute(update(uploads_table).values(expires_at=time.time() + 1))
        bodies.claim(c, "here", "u", 60)
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + ahead)
    with writing(engine) as c:
        assert not bodies.claim(c, "there", "u", 60)
        assert uploads.delete_expired(c) == []
        assert coming_bytes(c) == 60
        bodies.ask_for(c, "u")
        bodies.add(c, "there", 60, 60)
    monkeypatch.undo()
    with writing(engine) as c:
        assert bodies.is_wanted(c, "here")
        assert coming_bytes(c) == 120


def test_promise_decays_until_bytes_follow(engine: Engine) -> None:
    made(engine)
    with writing(engine) as c:
        uploads.advance(c, "u", 0, [Part("a", 30)], 1e6)
        c.execute(update(uploads_table).values(moved_at=time.time() - PROMISE - 1))
        assert (stored_bytes(c), promised_bytes(c)) == (ROW + PART + 30, 0)
    with writing(engine) as c:
        bodies.claim(c, "b", "u", 50)
    with reading(engine) as c:
        assert (stored_bytes(c), promised_bytes(c)) == (ROW + PART + 100, 20)
