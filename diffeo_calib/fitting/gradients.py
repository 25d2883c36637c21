"""Gradients of a fit by its measurements, noise and scales.

A fit is the fixed point m = T(m; y, s) of Gauss-Newton steps: momenta m, measurements y, logarithms of scales s. By the
implicit function theorem a loss L(m, s) of its model changes by

    dL/dy = lambda^T T_y,    dL/ds = L_s + lambda^T T_s,    lambda = L_m + T_m^T lambda,

and lambda is the limit of this iteration, which contracts where Gauss-Newton does (S. Bai, J. Z. Kolter, V. Koltun,
"Deep equilibrium models", 2019, section 3.1).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.fitting.problem import linear_optimum
from diffeo_calib.fitting.scales import rescaled
from diffeo_calib.maps.geodesic import GeodesicDeformation

MOST_STEPS = 200
CONVERGED = 1e-10  # change of lambda, relative to it, with which the iteration ends


class FitGradients(NamedTuple):
    """Derivatives of a loss."""

    y: Tensor  # (N, r) by the measurements
    prior: Tensor  # () by the logarithm of a factor on the prior deviations of theta
    noise: Tensor  # () by that of a factor on the deviations of the noise
    # (k,) by those of the kernels' scales, length scales before the amplitude, in the order of a kernel's terms
    joint_kernel: Tensor
    task_kernel: Tensor


@outside_inference_mode
@torch.enable_grad()
def gradients(fit: Any, x: object, loss: Callable[[Tensor], Tensor]) -> FitGradients:
    """See :meth:`Fit.gradients`."""
    if fit.formulation != "exact" or fit.problem.reduced or not fit.converged:
        expected = "a converged one of the exact formulation, with all data as control points"
        raise InputError.of("the fit", expected=expected, got=repr(fit))
    at = as_tensor(x, "x", ("M", fit.problem.x.shape[1])).detach()
    kernels = fit.problem.spec.joint_kernel, fit.problem.spec.task_kernel
    y = fit.problem.y.detach().requires_grad_()
    logs = y.new_zeros(2 + sum(kernel.scales for kernel in kernels), requires_grad=True)
    problem = rescaled(fit.problem, logs)._with(y=y)
    momenta = fit.momenta.flatten().detach().requires_grad_()
    unknowns = fit.momenta.unflatten(momenta)
    deformation = GeodesicDeformation(problem.spec, problem.x, unknowns, fit.integrator, variational=True)
    value = loss(deformation.linearised_value(at)[0])
    if not isinstance(value, Tensor) or value.numel() != 1 or not value.requires_grad:
        raise InputError.of("`loss`", expected="a differentiable scalar of k1(x)", got=str(value))
    step = linear_optimum(problem, deformation, "cholesky")[0].flatten()
    by_momenta, by_scales = torch.autograd.grad(value, (momenta, logs), retain_graph=True, materialize_grads=True)
    adjoint = by_momenta
    for _ in range(MOST_STEPS):
        before = adjoint
        adjoint = by_momenta + torch.autograd.grad(step, momenta, before, retain_graph=True)[0]
        if float((adjoint - before).norm()) <= CONVERGED * float(adjoint.norm()):
            break
    else:
        raise NumericalError.of("the gradient of the fit does not converge", fix="raise `noise`, or fit to its optimum")
    by_y, through = torch.autograd.grad(step, (y, logs), adjoint)
    sizes = [1, 1, *(kernel.scales for kernel in kernels)]
    prior, noise, joint, task = (by_scales + through).split(sizes)
    return FitGradients(by_y, prior[0], noise[0], joint, task)
