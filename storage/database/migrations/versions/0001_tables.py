"""The tables as they were before there were revisions.

A database from that time has all or some of them; existing tables stay as they are.
"""

from alembic import op
from sqlalchemy import JSON, BigInteger, Column, Float, ForeignKey, Integer, String, Text
from sqlalchemy.schema import SchemaItem

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Create the missing tables and indices."""
    _table(
        "captures",
        Column("number", Integer, primary_key=True, autoincrement=True),
        Column("id", String(32), nullable=False, unique=True),
        Column("name", Text, nullable=False),
        Column("state", String(16), nullable=False),
        Column("job", String(32), nullable=False),
        Column("bytes", BigInteger, nullable=False),
        Column("width", Integer),
        Column("height", Integer),
        Column("frames", Integer, nullable=False),
        Column("program", JSON, nullable=False),
        Column("problem", JSON),
        Column("created_at", Float, nullable=False),
    )
    _table(
        "mattes",
        Column("number", Integer, primary_key=True, autoincrement=True),
        Column("id", String(32), nullable=False, unique=True),
        Column("capture", String(32), nullable=False),
        Column("job", String(32), nullable=False),
        Column("state", String(16), nullable=False),
        Column("options", JSON, nullable=False),
        Column("figures", JSON),
        Column("created_at", Float, nullable=False),
    )
    _table(
        "programs",
        Column("number", Integer, primary_key=True, autoincrement=True),
        Column("id", String(32), nullable=False, unique=True),
        Column("program", JSON, nullable=False),
        Column("created_at", Float, nullable=False),
    )
    _table(
        "jobs",
        Column("number", Integer, primary_key=True, autoincrement=True),
        Column("id", String(32), nullable=False, unique=True),
        Column("kind", String(16), nullable=False),
        Column("state", String(16), nullable=False),
        Column("stage", String(16), nullable=False),
        Column("capture", String(32), nullable=False),
        Column("matte", String(32)),
        Column("options", JSON, nullable=False),
        Column("plan", JSON),
        Column("total", Integer, nullable=False),
        Column("done", Integer, nullable=False),
        Column("failed", Integer, nullable=False),
        Column("pixels", BigInteger, nullable=False),
        Column("problem", JSON),
        Column("created_at", Float, nullable=False),
        Column("started_at", Float),
        Column("finished_at", Float),
    )
    _index("ix_jobs_state", "jobs", "state")
    _table(
        "tiles",
        Column("job", String(32), ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
        Column("tile", Integer, primary_key=True),
        Column("state", String(16), nullable=False),
        Column("attempts", Integer, nullable=False),
        Column("seconds", Float),
    )
    _index("tiles_by_state", "tiles", "job", "state")
    _table(
        "log",
        Column("line", Integer, primary_key=True, autoincrement=True),
        Column("job", String(32), ForeignKey("jobs.id", ondelete="CASCADE"), nullable=False),
        Column("at", Float, nullable=False),
        Column("text", Text, nullable=False),
    )
    _index("ix_log_job", "log", "job")
    _table(
        "coordinator",
        Column("id", Integer, primary_key=True),
        Column("beat_at", Float, nullable=False),
        Column("workers", Integer, nullable=False),
        Column("threads", Integer, nullable=False),
    )
    _table(
        "uploads",
        Column("id", String(32), primary_key=True),
        Column("key", String(256), unique=True),
        Column("offset", BigInteger, nullable=False),
        Column("length", BigInteger, nullable=False),
        Column("parts", Integer, nullable=False),
        Column("metadata", Text, nullable=False),
        Column("created_at", Float, nullable=False),
        Column("expires_at", Float, nullable=False),
    )
    _index("ix_uploads_expires_at", "uploads", "expires_at")
    _table(
        "upload_parts",
        Column("upload", String(32), ForeignKey("uploads.id", ondelete="CASCADE"), primary_key=True),
        Column("offset", BigInteger, primary_key=True),
        Column("name", String(32), nullable=False),
        Column("size", BigInteger, nullable=False),
    )
    _table(
        "made",
        Column("key", String(256), primary_key=True),
        Column("call", String(64), primary_key=True),
        Column("id", String(32), nullable=False),
    )


def _table(name: str, *items: SchemaItem) -> None:
    op.create_table(name, *items, if_not_exists=True)


def _index(name: str, table: str, *columns: str) -> None:
    op.create_index(name, table, columns, if_not_exists=True)
