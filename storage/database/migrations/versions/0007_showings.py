"""A program has the playback progress that its player last reported."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    """Add the column."""
    op.add_column("programs", sa.Column("showing", sa.JSON(none_as_null=True)))
