"""Mattes: recovered tile by tile, and what is read from them."""
