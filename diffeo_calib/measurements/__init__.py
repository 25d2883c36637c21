"""Measured pairs (joint configuration, points or pose), and CSV files of them."""
