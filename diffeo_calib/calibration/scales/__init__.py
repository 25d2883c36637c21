"""Scales of kernels, priors and noise, chosen by marginal likelihood."""
