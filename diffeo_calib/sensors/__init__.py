"""Devices that report something other than coordinates: one file for each kind, and what they have in common."""
