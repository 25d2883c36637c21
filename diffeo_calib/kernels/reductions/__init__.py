"""Kernel sums sum_j w_ij b_j: formulas written once, run by interchangeable backends behind one door.

formulas.py says what is summed, pairs.py what a pairwise scalar is on tensors, dense.py, tiled.py and
keops.py how sums are run; door.py chooses. Nobody outside this folder knows which one ran.
"""
