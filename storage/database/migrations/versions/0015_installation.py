"""The id of the installation, which a service adds when it starts."""

from alembic import op
from sqlalchemy import Column, String

revision = "0015"
down_revision = "0014"


def upgrade() -> None:
    """Create the table."""
    op.create_table("installation", Column("id", String(32), primary_key=True))
