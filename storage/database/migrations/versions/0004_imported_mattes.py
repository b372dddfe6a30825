"""An imported matte has no capture and no job."""

from alembic import op
from sqlalchemy import String

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Make both columns nullable; SQLite copies the table for that."""
    with op.batch_alter_table("mattes") as table:
        for column in ("capture", "job"):
            table.alter_column(column, existing_type=String(32), nullable=True)
