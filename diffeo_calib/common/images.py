"""Formats of images."""

IMAGE_SUFFIXES = (".png", ".pdf", ".svg")
"""Suffixes of the files that figures can be written to."""
