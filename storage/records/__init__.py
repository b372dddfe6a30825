"""Rows of the database: one module for each kind of record."""
