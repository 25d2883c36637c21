"""What rows are conditioned with: scales of the fields, weights of heavy tails, evidence of unknowns."""
