"""Kernel sums sum_j w_ij b_j: formulas written once, evaluated by interchangeable backends.

formulas.py defines the sums, on pairwise scalars as matrices or as other symbols; it, tiled.py and keops.py evaluate
them; backends.py chooses between these. Nothing outside this folder depends on the choice.
"""
