"""The database: its tables, engine, revisions and the rule of who sees what."""
