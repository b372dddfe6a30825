"""The database: tables, engine, schema revisions, and row-level access by owner."""
