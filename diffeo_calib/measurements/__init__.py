"""Rows of measurements, whatever measured them: positions, poses, a ball in sockets, readings; and their CSV files."""
