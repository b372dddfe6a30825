"""Composites over HTTP: of pictures at once, of clips as jobs."""
