"""The coordinator's lease, columns for the pace and stalls of jobs, and totals."""

from alembic import op
from sqlalchemy import JSON, BigInteger, Column, Float, Integer, String

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Add the columns; recreate the coordinator's table, which held only its last heartbeat."""
    op.drop_table("coordinator")
    op.create_table(
        "coordinator",
        Column("id", Integer, primary_key=True),
        Column("token", Integer, nullable=False),
        Column("holder", String(64)),
        Column("expires_at", Float, nullable=False),
        Column("beat_at", Float, nullable=False),
        Column("cluster", JSON, nullable=False),
    )
    op.add_column("jobs", Column("misses", Integer, nullable=False, server_default="0"))
    op.add_column("jobs", Column("stage_at", Float))
    op.add_column("jobs", Column("moved_at", Float))
    op.add_column("jobs", Column("paced_at", Float))
    op.add_column("jobs", Column("paced_done", Integer, nullable=False, server_default="0"))
    op.add_column("jobs", Column("trace", String(64)))
    op.add_column("tiles", Column("losses", Integer, nullable=False, server_default="0"))
    op.create_table(
        "totals",
        Column("kind", String(16), primary_key=True),
        Column("tiles", BigInteger, nullable=False),
        Column("misses", BigInteger, nullable=False),
        Column("losses", BigInteger, nullable=False),
        Column("pixels", BigInteger, nullable=False),
        Column("seconds", Float, nullable=False),
    )
