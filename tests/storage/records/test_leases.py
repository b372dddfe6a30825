"""The coordinator's lease: acquired, renewed, expired, released, and required for commits."""

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


def acquire(engine: Engine, holder: str, *, seize: bool = False) -> int | None:
    with writing(engine) as c:
        return leases.acquire(c, holder, seize=seize)


def test_one_process_holds_the_lease(engine: Engine) -> None:
    assert acquire(engine, "first") == 1
    assert acquire(engine, "second") is None
    assert acquire(engine, "first") is None
    expire(engine)
    assert acquire(engine, "second") == 2
    assert acquire(engine, "first", seize=True) == 3


def test_lease_from_before_the_clock_went_back_is_free(engine: Engine) -> None:
    assert acquire(engine, "first") == 1
    hour = 3600
    with writing(engine) as c:
        values = {"expires_at": dialects.clock() + hour + leases.SECONDS, "beat_at": dialects.clock() + hour}
        c.execute(update(tables.coordinator).values(values))
    with reading(engine) as c:
        heartbeat = leases.last_heartbeat(c)
    assert heartbeat is not None
    assert heartbeat.seconds > hour - 5  # not negative, which would count as alive for an hour
    assert acquire(engine, "second") == 2


def test_released_lease_is_free(engine: Engine) -> None:
    token = acquire(engine, "first")
    assert token is not None
    with writing(engine) as c:
        leases.release(c, token)
    with writing(engine) as c, pytest.raises(Superseded):
        leases.require_held(c, token)
    assert acquire(engine, "second") == token + 1
    with writing(engine) as c:
        leases.release(c, token)  # late
    with writing(engine) as c:
        leases.require_held(c, token + 1)


def test_heartbeat_renews_lease(engine: Engine) -> None:
    token = acquire(engine, "first")
    assert token is not None
    expire(engine)
    with writing(engine) as c:
        leases.renew(c, token, {"workers": [{"name": "a"}], "problem": "none"})
    assert acquire(engine, "second") is None
    with reading(engine) as c:
        heartbeat = leases.last_heartbeat(c)
    assert heartbeat is not None
    assert heartbeat.holder == "first"
    assert heartbeat.cluster == {"workers": [{"name": "a"}], "problem": "none"}
    assert 0 <= heartbeat.seconds < 5


def test_no_heartbeat_without_coordinator(engine: Engine) -> None:
    with reading(engine) as c:
        assert leases.last_heartbeat(c) is None


def test_commit_of_superseded_coordinator_is_refused(engine: Engine) -> None:
    late = acquire(engine, "first")
    assert late is not None
    with writing(engine) as c:
        job = jobs.add(c, "recover", "cap", {}, "mat")
        tiles.add_plan(c, job, {"tiles": 2})
    expire(engine)
    token = acquire(engine, "second")
    with pytest.raises(Superseded), writing(engine) as c:  # noqa: PT012
        tiles.mark_done(c, job, [(0, 0.1, 10)])
        leases.require_held(c, late)
    with pytest.raises(Superseded), writing(engine) as c:
        leases.renew(c, late, {"workers": [], "problem": None})
    with reading(engine) as c:
        assert jobs.get(c, job).done == 0
        heartbeat = leases.last_heartbeat(c)
    assert heartbeat is not None
    assert (heartbeat.holder, token) == ("second", late + 1)


def test_one_of_many_acquires_the_lease(engine: Engine) -> None:
    got: list[int | None] = []
    threads = [
        threading.Thread(target=lambda n=n: got.append(acquire(engine, f"holder {n}"))) for n in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(token for token in got if token) == [1]
    with reading(engine) as c:
        assert c.scalar(select(func.count()).select_from(tables.coordinator)) == 1
