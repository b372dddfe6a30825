"""Verify, back up and restore an installation."""
