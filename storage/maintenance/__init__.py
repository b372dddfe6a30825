"""Verifying, backing up and restoring an installation."""
