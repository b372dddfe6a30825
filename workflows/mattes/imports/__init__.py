"""A matte that comes in an archive: checked as untrusted, and written to the store."""
