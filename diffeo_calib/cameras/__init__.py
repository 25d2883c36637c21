"""Cameras that see a board: lenses, boards, and what an image tells about a pose. No robot."""
