"""Jobs that are paused, and the parts of a frame that are wanted first."""

from alembic import op
from sqlalchemy import JSON, Boolean, Column, false

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Add the columns."""
    op.add_column("jobs", Column("paused", Boolean, nullable=False, server_default=false()))
    op.add_column("jobs", Column("region", JSON(none_as_null=True)))
