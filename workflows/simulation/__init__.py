"""Traced scenes, for the demo and the tests."""
