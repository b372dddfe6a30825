"""Bodies under way, when bytes of an upload last came, and how large the rows of captures and jobs are."""

from alembic import op
from sqlalchemy import BigInteger, Column, Float, ForeignKey, String, Text, cast, func, table, update
from sqlalchemy.sql import column

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """Add the table and the columns, and count the rows that exist."""
    op.create_table(
        "bodies",
        Column("id", String(32), primary_key=True),
        Column("upload", String(32), ForeignKey("uploads.id", ondelete="CASCADE"), unique=True),
        Column("length", BigInteger, nullable=False),
        Column("bytes", BigInteger, nullable=False),
        Column("stored", BigInteger, nullable=False),
        Column("renewed_at", Float, nullable=False),
        Column("wanted_at", Float),
        Column("owner", String(64), nullable=False, server_default="default"),
    )
    op.add_column("uploads", Column("moved_at", Float, nullable=False, server_default="0"))
    for name, document in (("captures", "program"), ("jobs", "plan")):
        op.add_column(name, Column("row_bytes", BigInteger, nullable=False, server_default="0"))
        size = func.coalesce(func.length(cast(column(document), Text)), 0)
        op.execute(update(table(name, column("row_bytes"))).values(row_bytes=size))
