"""Statements over an engine that is bound to an owner."""

import pytest
from sqlalchemy import Engine, Executable, delete, exists, func, insert, select, text, union, update

from storage.database import tables
from storage.database.engine import reading, writing
from storage.database.owners import NOBODY, across_owners, for_owner
from storage.database.rows import page
from storage.errors import NotFound
from storage.layout import uploads as stored_uploads
from storage.records import captures, jobs, leases, tiles, uploads

OWNERS = ("alice", "bob")


@pytest.fixture
def filled(engine: Engine) -> Engine:
    """A database in which alice and bob each have an active job, a capture and an upload."""
    for owner in OWNERS:
        with writing(for_owner(engine, owner)) as c:
            jobs.add(c, "ingest", f"{owner}-capture", {}, job=f"{owner}-job")
            tiles.add_steps(c, f"{owner}-job")
            captures.add(c, f"{owner}-capture", f"{owner}-job", name="", bytes=1, frames=1, program={})
            uploads.add(c, f"{owner}-upload", 10, "", 60, "the-same-key")
            uploads.advance(c, f"{owner}-upload", 0, [stored_uploads.Part(owner, 4)], 60)
    return engine


def test_lists_and_lookups_show_only_the_owners_rows(filled: Engine) -> None:
    for owner, other in (OWNERS, OWNERS[::-1]):
        with reading(for_owner(filled, owner)) as c:
            for table, what in ((tables.captures, "capture"), (tables.jobs, "job")):
                assert [row.id for row in page(c, table, 10, None)] == [f"{owner}-{what}"]
                with pytest.raises(NotFound):
                    page(c, table, 10, f"{other}-{what}")
            for get, what in ((captures.get, "capture"), (jobs.get, "job"), (uploads.get, "upload")):
                assert get(c, f"{owner}-{what}").owner == owner
                with pytest.raises(NotFound):
                    get(c, f"{other}-{what}")
            assert jobs.active_job(c, capture=f"{owner}-capture") == f"{owner}-job"
            assert jobs.active_job(c, capture=f"{other}-capture") is None
            found = uploads.by_key(c, "the-same-key")
            assert found is not None
            assert found.owner == owner
    with reading(filled) as c:
        assert [row.id for row in jobs.to_run(c)] == [f"{owner}-job" for owner in OWNERS]
    with reading(for_owner(filled, NOBODY)) as c:
        assert jobs.active_job(c, capture="alice-capture") is None


def test_dependent_rows_belong_to_the_owner(filled: Engine) -> None:
    with reading(for_owner(filled, "alice")) as c:
        assert [line.text for line in jobs.log_lines(c, "alice-job", 0, 10)] == ["queued"]
        assert jobs.log_lines(c, "bob-job", 0, 10) == []
        assert uploads.parts_of(c, "alice-upload") == [stored_uploads.Part("alice", 4)]
        assert uploads.parts_of(c, "bob-upload") == []
        for joined in (
            select(tables.jobs.c.id).join(tables.tiles),
            select(tables.jobs.c.id).outerjoin(tables.tiles),
            select(tables.tiles.c.job).join(tables.jobs),
            select(tables.log.c.job).join(tables.tiles, tables.tiles.c.job == "bob-job"),
        ):
            assert set(c.scalars(joined)) <= {"alice-job"}


def test_changes_and_deletions_affect_only_the_owners_rows(filled: Engine) -> None:
    with writing(for_owner(filled, "alice")) as c:
        assert c.execute(update(tables.jobs).values(stage="mine")).rowcount == 1
        assert c.execute(update(tables.tiles).values(attempts=7)).rowcount == 2
        assert c.execute(delete(tables.log)).rowcount == 1
        assert not uploads.delete(c, "bob-upload")
        assert c.execute(delete(tables.captures)).rowcount == 1
    with reading(filled) as c:
        assert jobs.get(c, "bob-job").stage == "waiting"
        assert len(jobs.log_lines(c, "bob-job", 0, 10)) == 1
        assert c.scalar(select(func.sum(tables.tiles.c.attempts)).where(tables.tiles.c.job == "bob-job")) == 0
        assert captures.exists(c, "bob-capture")


def test_sum_over_all_owners_needs_across_owners(filled: Engine) -> None:
    query = select(func.count()).select_from(tables.jobs)
    with reading(for_owner(filled, "alice")) as c:
        assert c.scalar(query) == 1
        assert c.scalar(across_owners(query)) == 2


@pytest.mark.parametrize(
    "statement",
    [
        text("SELECT * FROM jobs"),
        select(text("* FROM jobs")),
        select(tables.totals),
        select(tables.keys),
        select(tables.captures).where(exists().where(tables.jobs.c.id == "x")),
        select(tables.jobs.c.id).where(tables.jobs.c.id.in_(select(tables.mattes.c.job))),
        select(tables.jobs.alias()),
        select(select(tables.jobs).subquery()),
        select(tables.jobs).cte().select(),
        select(select(tables.jobs.c.id).limit(1).scalar_subquery()),
        union(select(tables.jobs.c.id), select(tables.captures.c.id)),
        insert(tables.made).from_select(
            ["key", "call", "id"], select(tables.jobs.c.id, tables.jobs.c.id, tables.jobs.c.id)
        ),
        delete(tables.log).where(tables.log.c.job.in_(select(tables.jobs.c.id))),
        update(tables.totals).values(tiles=0),
    ],
    ids=lambda statement: " ".join(str(statement).split())[:60],
)
def test_statement_that_cannot_be_restricted_is_refused(engine: Engine, statement: Executable) -> None:
    with writing(for_owner(engine, "alice")) as c, pytest.raises(TypeError, match="owner"):
        c.execute(statement)


def test_every_table_is_restricted_or_known_to_be_shared(engine: Engine) -> None:
    refused = set()
    for name, table in tables.metadata.tables.items():
        with reading(for_owner(engine, "alice")) as c:
            try:
                assert c.execute(select(table)).all() == []
            except TypeError:
                refused.add(name)
    assert refused == {"totals", "keys", "deliveries", "installation"}


def test_every_owner_can_read_the_coordinator(engine: Engine) -> None:
    with writing(engine) as c:
        leases.acquire(c, "me")
    with reading(for_owner(engine, NOBODY)) as c:
        heartbeat = leases.last_heartbeat(c)
        assert heartbeat is not None
        assert heartbeat.holder == "me"
