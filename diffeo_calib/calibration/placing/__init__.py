"""Where devices and markers are: before the exact fit, and after it."""
