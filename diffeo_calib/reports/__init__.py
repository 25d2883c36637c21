"""Reports of a calibration: analysis, plots, and one HTML page."""
