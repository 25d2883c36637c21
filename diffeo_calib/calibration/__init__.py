"""Calibration of a robot from measurements: registration, geometry, scales, and the exact fit."""
