"""The paper's own formulation, algorithms and figures, kept for comparison."""
