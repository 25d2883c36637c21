"""Panels of pictures of calibrations, drawn into axes of matplotlib."""
