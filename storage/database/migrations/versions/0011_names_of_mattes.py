"""Names of mattes."""

from alembic import op
from sqlalchemy import Column, Text, func, select, table, text, update
from sqlalchemy.sql import column

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    """Add the column, and name mattes after their captures, as far as these still exist."""
    op.add_column("mattes", Column("name", Text, nullable=False, server_default=text("''")))
    mattes = table("mattes", column("name"), column("capture"))
    captures = table("captures", column("id"), column("name"))
    of_capture = select(captures.c.name).where(captures.c.id == mattes.c.capture).scalar_subquery()
    op.execute(update(mattes).values(name=func.coalesce(of_capture, "")))
