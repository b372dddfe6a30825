"""What a job does next, by what became of its tiles: against a real ledger."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import Connection, select

from services.cluster.dispatcher import Outcome
from services.coordinator.job_run import LOSSES, Drive
from storage.database.engine import open_engine, writing
from storage.database.tables import tiles, totals
from storage.errors import Corrupt, Unavailable
from storage.records import captures, job_log, jobs, mattes
from storage.records import tiles as tile_records
from storage.steps import FINISH, PREPARE
from workflows.untrusted.limits import Limits

LIMITS = Limits(1 << 30, 1 << 26)


@pytest.fixture
def connection(tmp_path: Path) -> Iterator[Connection]:
    engine = open_engine(f"sqlite:///{tmp_path}/ledger.db")
    with writing(engine) as connection:
        yield connection
    engine.dispose()


@pytest.fixture
def job(connection: Connection) -> str:
    captures.add(connection, "cap", "other", name="", bytes=0, frames=0, program={})
    job = jobs.add(connection, "recover", "cap", {}, "mat")
    mattes.add(connection, "mat", "cap", job, {})
    return job


def taken_up(connection: Connection, job: str) -> Drive:
    tile_records.begin(connection, job)
    drive = Drive.of(jobs.get(connection, job), tile_records.to_do(connection, job), "file:///store", LIMITS)
    jobs.enter(connection, job, drive.stage)
    return drive


def told(connection: Connection, drive: Drive, *news: Outcome, under_way: int = 0) -> bool:
    """Tell a drive what became of tiles that it had handed over; whether it goes on."""
    for outcome in news:
        if outcome.tile in drive.to_do:
            drive.to_do.remove(outcome.tile)
        drive.hear(outcome)
    following = drive.settle(connection, 3, 2, under_way)
    drive.go_on(following)
    return not following.ended


def done(drive: Drive, tile: int, result: object = 10) -> Outcome:
    return Outcome(drive.job, tile, done=(0.1, result))


def working(connection: Connection, job: str, tiles: int = 3) -> Drive:
    drive = taken_up(connection, job)
    assert told(connection, drive, done(drive, PREPARE, {"tiles": tiles}))
    return drive


def lines(connection: Connection, job: str) -> list[str]:
    return [row.text for row in job_log.notes(connection, job, 0, 100)]


def test_from_the_first_step_to_the_last(connection: Connection, job: str) -> None:
    drive = taken_up(connection, job)
    assert list(drive.to_do) == [PREPARE]
    assert told(connection, drive, done(drive, PREPARE, {"tiles": 3}))
    assert (drive.stage, sorted(drive.to_do), drive.task.plan) == ("recovering", [0, 1, 2], {"tiles": 3})
    assert told(connection, drive, done(drive, 0), done(drive, 1), under_way=1)
    assert told(connection, drive, done(drive, 2))
    assert (drive.stage, list(drive.to_do)) == ("finishing", [FINISH])
    assert not told(connection, drive, done(drive, FINISH, {"width": 4}))
    assert jobs.get(connection, job).state == "succeeded"
    matte = mattes.get(connection, "mat")
    assert (matte.state, matte.figures) == ("ready", {"width": 4})
    seconds = dict(connection.execute(select(tiles.c.tile, tiles.c.seconds).where(tiles.c.job == job)).all())
    assert seconds == dict.fromkeys((PREPARE, FINISH, 0, 1, 2), 0.1)
    assert connection.scalar(select(totals.c.seconds)) == pytest.approx(0.3)  # the tiles'


def test_its_share_is_what_it_had_and_what_is_under_way(connection: Connection, job: str) -> None:
    drive = taken_up(connection, job)
    drive.start = 5.0
    assert (drive.used(), drive.used(under_way=2)) == (5.0, 5.0)
    drive.hear(Outcome(job, 0, done=(0.5, 10)))
    drive.hear(Outcome(job, 1, error=OSError()))
    drive.hear(Outcome(job, 2, done=(1.5, 10)))
    assert (drive.used(), drive.used(under_way=2)) == (7.0, 9.0)


def test_it_is_taken_up_where_it_stands(connection: Connection, job: str) -> None:
    drive = working(connection, job)
    told(connection, drive, done(drive, 1), under_way=2)
    again = taken_up(connection, job)
    assert (again.stage, sorted(again.to_do), again.task) == ("recovering", [0, 2], drive.task)
    told(connection, again, done(again, 0), done(again, 2))
    assert list(taken_up(connection, job).to_do) == [FINISH]


def test_what_is_gone_is_done_again_and_blames_nobody(connection: Connection, job: str) -> None:
    drive = working(connection, job)
    for _ in range(20):
        assert told(connection, drive, Outcome(job, 1))
        assert sorted(drive.to_do) == [0, 1, 2]
    assert lines(connection, job)[-1] == "recovering"


@pytest.mark.parametrize("tile", [PREPARE, 1, FINISH])
def test_what_fails_is_tried_three_times(connection: Connection, job: str, tile: int) -> None:
    drive = taken_up(connection, job) if tile == PREPARE else working(connection, job)
    if tile == FINISH:
        told(connection, drive, *(done(drive, n) for n in range(3)))
    error = Outcome(job, tile, error=ValueError("odd"))
    assert [told(connection, drive, error) for _ in range(3)] == [True, True, False]
    row = jobs.get(connection, job)
    assert row.state == "failed"
    assert "failed 3 times, last with ValueError('odd')" in row.problem["detail"]
    assert mattes.get(connection, "mat").state == "failed"


def test_what_may_go_well_later_is_tried_again_and_what_can_not_is_not(
    connection: Connection, job: str
) -> None:
    drive = working(connection, job)
    assert told(connection, drive, Outcome(job, 0, error=Unavailable("the store is away")))
    assert not told(connection, drive, Outcome(job, 0, error=Corrupt("it is damaged")))
    assert jobs.get(connection, job).problem["detail"] == "it is damaged"


def test_a_tile_of_which_workers_die(connection: Connection, job: str) -> None:
    drive = working(connection, job)
    death = Outcome(job, 1, died="tls://host:1")
    assert [told(connection, drive, death) for _ in range(LOSSES)] == [True] * (LOSSES - 1) + [False]
    assert "ENVMATTE_WORKER_MEMORY" in jobs.get(connection, job).problem["detail"]
    assert jobs.get(connection, job).failed == 1


def test_a_tile_that_wants_more_memory_than_there_is(connection: Connection, job: str) -> None:
    drive = working(connection, job)
    death = Outcome(job, 1, died="tls://host:1", starved=True)
    assert [told(connection, drive, death) for _ in range(3)] == [True, True, False]
    detail = jobs.get(connection, job).problem["detail"]
    assert (
        "tile 1 ran out of its worker's memory 3 times: give workers more (ENVMATTE_WORKER_MEMORY)" in detail
    )


def test_what_the_store_lacks_is_done_again(connection: Connection, job: str) -> None:
    drive = working(connection, job)
    told(connection, drive, *(done(drive, n) for n in range(3)))
    assert told(connection, drive, done(drive, FINISH, {"missing": [1]}))
    assert (drive.stage, list(drive.to_do)) == ("recovering", [1])
    assert told(connection, drive, done(drive, 1))
    assert (drive.stage, list(drive.to_do)) == ("finishing", [FINISH])
    assert not told(connection, drive, done(drive, FINISH, {}))
    row = jobs.get(connection, job)
    assert (row.state, row.done, row.pixels) == ("succeeded", 3, 30)


def test_a_job_that_was_cancelled_stays_so(connection: Connection, job: str) -> None:
    drive = working(connection, job)
    told(connection, drive, *(done(drive, n) for n in range(3)))
    jobs.cancel(connection, job)
    assert not told(connection, drive, done(drive, FINISH, {}))
    assert jobs.get(connection, job).state == "cancelled"
    assert mattes.get(connection, "mat").state == "recovering"
