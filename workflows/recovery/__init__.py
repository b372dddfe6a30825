"""Pixel recovery: arrays in, arrays out."""
