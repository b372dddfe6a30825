"""When jobs were queued again."""

from alembic import op
from sqlalchemy import Column, Float

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    """Add the column."""
    op.add_column("jobs", Column("queued_at", Float))
