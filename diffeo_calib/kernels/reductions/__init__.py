"""Kernel sums sum_j w_ij b_j: formulas written once, evaluated by interchangeable backends.

formulas.py defines the sums, on pairwise scalars as matrices or as other symbols, and evaluates them densely; tiled.py,
fused/, keops.py and distributed.py evaluate them without the matrix of all pairs. backends.py has the table of the
backends and chooses between them. Nothing outside this folder depends on the choice.
"""
