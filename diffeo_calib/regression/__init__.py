"""Gaussian regression of the linearised model: what momenta the data ask for, and what they leave uncertain.

Around a deformation, k1 at the data is linear in the fields and in theta. Three ways to condition on the
data, behind one interface (conditional.py): a Cholesky factor of G + R (dense.py), preconditioned conjugate
gradients on kernel sums (iterative.py), or normal equations in the momenta of a few control points (reduced.py).
"""
