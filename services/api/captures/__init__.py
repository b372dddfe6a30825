"""Captures over HTTP: uploads and reports."""
