"""Where kernels and robots meet: the fitting problem, its solvers, and `calibrate`."""
