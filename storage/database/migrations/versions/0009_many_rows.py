"""Indexes for sums and searches over very many rows, and a mark on cancelled jobs with something left to remove."""

from alembic import op
from sqlalchemy import Boolean, Column, exists, false, or_, table, true, update
from sqlalchemy.sql import column

revision = "0009"
down_revision = "0008"


def upgrade() -> None:
    """Add the indexes and the column, and mark the jobs that exist."""
    op.add_column("jobs", Column("leftovers", Boolean, nullable=False, server_default=false()))
    jobs = table("jobs", *map(column, ("id", "kind", "state", "leftovers")))
    captures, mattes = (table(name, column("job"), column("state")) for name in ("captures", "mattes"))
    tiles = table("tiles", column("job"))
    left = or_(
        exists().where(captures.c.job == jobs.c.id, captures.c.state == "ingesting"),
        exists().where(mattes.c.job == jobs.c.id, mattes.c.state == "recovering"),
        (jobs.c.kind == "composite") & exists().where(tiles.c.job == jobs.c.id),
    )
    op.execute(update(jobs).where(jobs.c.state == "cancelled", left).values(leftovers=true()))
    op.drop_index("ix_jobs_state", "jobs")
    for index, columns in (
        ("captures_by_state", "state bytes"),
        ("captures_by_size", "stored state owner bytes row_bytes"),
        ("mattes_by_state", "state"),
        ("mattes_by_size", "stored state owner"),
        ("jobs_by_state", "state leftovers"),
        ("jobs_by_owner_and_state", "owner state number"),
        ("jobs_by_kind", "kind state stored total done failed"),
        ("jobs_by_size", "owner stored row_bytes total"),
    ):
        op.create_index(index, index.partition("_")[0], columns.split())
