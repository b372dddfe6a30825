"""Mattes over HTTP: composites, clips, layers, archives."""
