"""Reports of a calibration: figures."""
