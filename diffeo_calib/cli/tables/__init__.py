"""From the options of a command to the table that they describe, and what is printed about it."""
