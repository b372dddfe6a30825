"""Mattes encoded for compositing in a browser, on graphics hardware."""
