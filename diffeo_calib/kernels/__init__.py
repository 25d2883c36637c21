"""Reproducing kernels of vector fields: radial profile, space and output matrix. Kernel sums are in `reductions`."""
