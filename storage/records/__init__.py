"""Rows of the database, one file for each kind of record."""
