"""Kernel sums sum_j w_ij b_j: formulas written once, evaluated by interchangeable backends.

formulas.py defines the sums and evaluates them densely. symbols.py records what a formula and a profile compute for a
pair of points; tiled.py, fused.py (with loops.py) and keops.py lower that record, distributed.py shares the work.
backends.py has the table of the backends and chooses between them. Nothing outside this folder depends on the choice.
"""
