"""Owners, API keys, expiry of captures and mattes, and their size in the store.

Existing rows belong to the default owner.
"""

from alembic import op
from sqlalchemy import BigInteger, Column, Float, Integer, MetaData, String, Table, Text, insert, select

revision = "0005"
down_revision = "0004"

# The names that PostgreSQL gives to unnamed constraints. SQLite copies the table, and alembic finds them by these.
NAMES = {"uq": "%(table_name)s_%(column_0_name)s_key", "pk": "%(table_name)s_pkey"}


def upgrade() -> None:
    """Add the table and the columns; unique constraints now hold per owner."""
    op.create_table(
        "keys",
        Column("number", Integer, primary_key=True, autoincrement=True),
        Column("name", Text, nullable=False),
        Column("hash", String(64), nullable=False, unique=True),
        Column("owner", String(64), nullable=False),
        Column("scope", String(8), nullable=False),
        Column("created_at", Float, nullable=False),
        Column("revoked_at", Float),
    )
    for name in ("captures", "mattes", "jobs"):
        op.add_column(name, _owner())
        op.add_column(name, Column("stored", BigInteger))
        op.create_index(f"{name}_by_owner", name, ["owner", "number"])
    for name in ("captures", "mattes"):
        op.add_column(name, Column("expires_at", Float))
        op.create_index(f"ix_{name}_expires_at", name, ["expires_at"])
    _unique_by_owner("programs", "id")
    op.create_index("programs_by_owner", "programs", ["owner", "number"])
    _idempotency_keys_by_owner()
    parts = Table("upload_parts", MetaData(), autoload_with=op.get_bind())
    known = op.get_bind().execute(select(parts)).mappings().all()
    _unique_by_owner("uploads", "key")
    # SQLite dropped the uploads table to copy it, which deleted the rows that refer to it.
    if known and op.get_bind().scalar(select(parts).limit(1)) is None:
        op.get_bind().execute(insert(parts), [dict(part) for part in known])


def _owner() -> Column[str]:
    return Column("owner", String(64), nullable=False, server_default="default")


def _unique_by_owner(name: str, column: str) -> None:
    with op.batch_alter_table(name, naming_convention=NAMES) as table:
        table.add_column(_owner())
        table.drop_constraint(f"{name}_{column}_key", type_="unique")
        table.create_unique_constraint(f"{name}_owner_{column}_key", ["owner", column])


def _idempotency_keys_by_owner() -> None:
    with op.batch_alter_table("made", naming_convention=NAMES) as table:
        table.add_column(_owner())
        table.drop_constraint("made_pkey", type_="primary")
        table.create_primary_key("made_pkey", ["owner", "key", "call"])
