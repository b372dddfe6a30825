"""The lease of the coordinator: who has it, when it runs out, and that a late writer's commit is refused."""

import threading

import pytest
from sqlalchemy import Engine, func, select, update

from storage.database import dialects, tables
from storage.database.engine import reading, writing
from storage.records import jobs, leases, tiles
from storage.records.leases import Superseded


def expire(engine: Engine) -> None:
    with writing(engine) as c:
        c.execute(update(tables.coordinator).values(expires_at=dialects.clock() - 1))


def take(engine: Engine, holder: str, *, seize: bool = False) -> int | None:
    with writing(engine) as c:
        return leases.acquire(c, holder, seize=seize)


def test_one_has_it(engine: Engine) -> None:
    assert take(engine, "first") == 1
    assert take(engine, "second") is None
    assert take(engine, "first") is None
    expire(engine)
    assert take(engine, "second") == 2
    assert take(engine, "first", seize=True) == 3


def test_a_lease_that_is_given_back_is_free(engine: Engine) -> None:
    token = take(engine, "first")
    assert token is not None
    with writing(engine) as c:
        leases.release(c, token)
    with writing(engine) as c, pytest.raises(Superseded):
        leases.require_held(c, token)
    assert take(engine, "second") == token + 1
    with writing(engine) as c:
        leases.release(c, token)  # late
    with writing(engine) as c:
        leases.require_held(c, token + 1)


def test_a_beat_extends_it(engine: Engine) -> None:
    token = take(engine, "first")
    assert token is not None
    expire(engine)
    with writing(engine) as c:
        leases.renew(c, token, {"workers": [{"name": "a"}], "problem": "none"})
    assert take(engine, "second") is None
    with reading(engine) as c:
        sign = leases.last_heartbeat(c)
    assert sign is not None
    assert sign.holder == "first"
    assert sign.cluster == {"workers": [{"name": "a"}], "problem": "none"}
    assert 0 <= sign.seconds < 5


def test_nobody_ever_had_it(engine: Engine) -> None:
    with reading(engine) as c:
        assert leases.last_heartbeat(c) is None


def test_a_late_writers_commit_is_refused(engine: Engine) -> None:
    late = take(engine, "first")
    assert late is not None
    with writing(engine) as c:
        job = jobs.add(c, "recover", "cap", {}, "mat")
        tiles.add_plan(c, job, {"tiles": 2})
    expire(engine)
    token = take(engine, "second")
    with pytest.raises(Superseded), writing(engine) as c:  # noqa: PT012
        tiles.mark_done(c, job, [(0, 0.1, 10)])
        leases.require_held(c, late)
    with pytest.raises(Superseded), writing(engine) as c:
        leases.renew(c, late, {"workers": [], "problem": None})
    with reading(engine) as c:
        assert jobs.get(c, job).done == 0
        sign = leases.last_heartbeat(c)
    assert sign is not None
    assert (sign.holder, token) == ("second", late + 1)


def test_of_many_who_want_it_one_gets_it(engine: Engine) -> None:
    got: list[int | None] = []
    wanting = [threading.Thread(target=lambda n=n: got.append(take(engine, f"holder {n}"))) for n in range(8)]
    for thread in wanting:
        thread.start()
    for thread in wanting:
        thread.join()
    assert sorted(token for token in got if token) == [1]
    with reading(engine) as c:
        assert c.scalar(select(func.count()).select_from(tables.coordinator)) == 1
