"""Constants of the measured and resting rows of one arm."""

DISTANCES = {("0", "1"): 0.05}
TRACKED = 25
"""Rows of the tracker in a mixture; the other 20 are new."""
