"""Webhooks: a job's URL, and the deliveries to make."""

from alembic import op
from sqlalchemy import Column, Float, Integer, String, Text

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """Add the column and the table."""
    op.add_column("jobs", Column("webhook", Text))
    op.create_table(
        "deliveries",
        Column("id", String(32), primary_key=True),
        Column("job", String(32), nullable=False),
        Column("url", Text, nullable=False),
        Column("body", Text, nullable=False),
        Column("attempts", Integer, nullable=False),
        Column("due_at", Float, nullable=False),
        Column("created_at", Float, nullable=False),
    )
    op.create_index("ix_deliveries_due_at", "deliveries", ["due_at"])
