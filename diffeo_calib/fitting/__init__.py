"""Fit k1 = psi o k0 o phi^-1 for any smooth map k0: the problem, its solvers, the result."""
