"""Failed attempts at a job's steps are counted with its tiles."""

from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Drop the column that counted them per job."""
    op.drop_column("jobs", "misses")
