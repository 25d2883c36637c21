"""Kinematics of a robot as maps: nominal with geometric errors, calibrated, and their errors on measurements."""
