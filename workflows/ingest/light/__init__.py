"""Stored frames as light: the values of a camera, its tone curve, exposure and local tone mapping undone."""
