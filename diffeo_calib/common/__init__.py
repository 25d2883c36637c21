"""Used by every other folder: errors, checks of input, threads."""
