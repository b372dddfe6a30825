"""Simulated scenes for the demo and the tests."""
