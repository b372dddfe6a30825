"""Composites of clips, in segments."""
