"""Registration and classical geometric calibration."""
