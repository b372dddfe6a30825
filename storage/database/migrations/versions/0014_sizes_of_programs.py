"""How large the rows of programs are, and an index of the mattes of a capture."""

from alembic import op
from sqlalchemy import BigInteger, Column, Text, cast, func, table, update
from sqlalchemy.sql import column

revision = "0014"
down_revision = "0013"


def upgrade() -> None:
    """Add the column and the indexes, and count the rows that exist."""
    op.add_column("programs", Column("row_bytes", BigInteger, nullable=False, server_default="0"))
    size = func.length(cast(column("program"), Text))
    op.execute(update(table("programs", column("row_bytes"))).values(row_bytes=size))
    op.create_index("programs_by_size", "programs", ["owner", "row_bytes"])
    op.create_index("mattes_by_capture", "mattes", ["capture", "owner", "number"])
