"""The paper's own formulation, kept for comparison."""
