"""Reproducing kernels of vector fields: profile + space + matrix; kernel sums in `reductions`."""
