"""The script that alembic runs for an upgrade; see `storage.database.migrations.upgrade`."""

from alembic import context

context.configure(connection=context.config.attributes["connection"])
context.run_migrations()
