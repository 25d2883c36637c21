"""Kernel sums sum_j w_ij b_j: formulas written once, evaluated by interchangeable backends.

formulas.py says what is summed, pairs.py what a pairwise scalar is on tensors; dense.py, tiled.py and keops.py evaluate
sums; backends.py chooses between them. Nothing outside this folder depends on the choice.
"""
