"""A matte that comes in an archive: checked as hostile, and written anew."""
