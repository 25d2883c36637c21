"""A calibrated model as plain arrays, evaluated by NumPy alone: fast queries, and the contents of exported programs."""
