"""Links that let anyone see one matte."""

from alembic import op
from sqlalchemy import Column, Float, ForeignKey, String

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    """Add the table."""
    op.create_table(
        "links",
        Column("id", String(32), primary_key=True),
        Column("hash", String(64), nullable=False, unique=True),
        Column("matte", String(32), ForeignKey("mattes.id", ondelete="CASCADE"), nullable=False, index=True),
        Column("created_at", Float, nullable=False),
        Column("expires_at", Float, nullable=False, index=True),
        Column("owner", String(64), nullable=False, server_default="default"),
    )
