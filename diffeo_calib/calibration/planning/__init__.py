"""Which poses to measure: candidates, the choice among them, and their order."""
