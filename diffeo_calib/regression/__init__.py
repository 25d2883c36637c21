"""Gaussian regression of the linearised model: the posterior mean and covariance of its momenta and parameters.

Around a deformation, k1 at the data is linear in the fields and in theta. There are three ways to condition on the
data, with one interface (conditional.py): a Cholesky factor of F + R there, which also takes rows one block after the
other, preconditioned conjugate gradients on kernel sums (conjugate_gradients.py), or normal equations in the momenta of
a few control points (control_points.py).
"""
