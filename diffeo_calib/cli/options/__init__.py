"""The options of the commands: their types and their help."""
