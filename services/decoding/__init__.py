"""Decoding of the untrusted pictures of requests."""
