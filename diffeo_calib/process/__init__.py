"""What is known of a robot and its devices from the rows that were measured: one Gaussian process."""
