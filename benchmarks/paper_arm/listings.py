"""The paper's two algorithms with its own names, for comparison with Listings 1 and 2 line by line.

R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025.
The algorithms use the parts of :func:`diffeo_calib.fit` with ``formulation="eulerian"``; :class:`Eulerian` lists the
errata.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_count, check_finite, check_number
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.fitting.problem import Problem, slope
from diffeo_calib.flows.integrators import RK4, Integrator
from diffeo_calib.kernels.base import Kernel, check_kernel
from diffeo_calib.maps.deformation import ModelSpec, Momenta
from diffeo_calib.maps.nominal import NominalMap, as_nominal
from diffeo_calib.paper.eulerian import Eulerian, EulerianDeformation, EulerianProblem

Nominal = NominalMap | Callable[[Tensor], Tensor]
Calibration = tuple[Tensor, Tensor, Nominal, Kernel, Kernel]
"""(X, P0, k, K_V, K_W), the "tuple encoding the calibrated kinematics"."""


class Descent(NamedTuple):
    """Parameters of the gradient descent in Listing 1.

    Args:
        mu: step, below 2 / (largest eigenvalue of the Hessian), which at the start of section 5 is 4e-10.
        epsilon: tolerance of the gradient's norm. max_iter: limit of iterations.
    """

    mu: float
    epsilon: float
    max_iter: int


class Discretisation(NamedTuple):
    """Variant and time stepping of (17) and (20).

    Args:
        equations: the errata to keep as printed.
        integrator: of both flows.
    """

    equations: Eulerian = Eulerian()
    integrator: Integrator = RK4(2)


def lr_calibration(  # noqa: PLR0917  # as printed
    X: object,
    Y: object,
    k: Nominal,
    K_V: Kernel,
    K_W: Kernel,
    sigma: float,
    descent: Descent,
    discretisation: Discretisation | None = None,
) -> Calibration:
    """Algorithm 1, LR calibration, offline part: gradient descent on (16) with a fixed step.

    Args:
        X: (N, n) configurations, rad or m. Y: (N, m) measured end-effector positions, m.
        k: nominal kinematics. K_V, K_W: reproducing kernels.
        sigma: of (5), m. Section 5 gives "the regularization parameter sigma = 100". As the sigma of (5), 100 would
            leave the model undeformed, since residuals of 0.1 would cost only 1e-6 each. As the weight 1 / (2 sigma^2)
            it means sigma = 0.0707; as 1 / sigma it means the 0.01 of :func:`section_5`, which reaches the reported
            accuracy.
        descent: mu, epsilon and max_iter.
        discretisation: of (17).

    Returns:
        (X, P0, k, K_V, K_W), with P0 (N, m).

    Raises:
        InputError: wrong shapes or values.
        NumericalError: the descent diverges.
    """
    mu, epsilon, max_iter = descent
    check_number(mu, "`mu`", above=0.0)
    check_number(epsilon, "`epsilon`", above=0.0)
    check_count(max_iter, "`max_iter`")
    equations, integrator = discretisation or Discretisation()
    problem = EulerianProblem(Problem(k, X, Y, joint_kernel=K_V, task_kernel=K_W, noise=sigma), equations)
    P0 = torch.zeros_like(problem.y)  # Initialize P_0 = (P_0^1, ..., P_0^N) <- 0
    i = 0  # Set iteration counter (printed: k <- 0, which shadows the kinematics)
    while i < max_iter:
        P0.requires_grad_()
        found = slope(problem, integrator, replace(problem.zero(), task=P0), P0)  # Solve ODEs (17); gradient of (16)
        if found is None:
            raise NumericalError.of(f"Algorithm 1 diverges after {i} iterations", fix="lower `mu`")
        gradient, P0 = found[1], P0.detach()
        if float(gradient.norm()) < epsilon:
            break  # Convergence criteria met
        P0 = P0 - mu * gradient  # Update the momenta
        i = i + 1  # Increment iteration counter
    return problem.x, P0.detach(), k, K_V, K_W  # Tuple encoding the calibrated kinematics


def evaluate(  # noqa: PLR0917  # as printed
    xi: object,
    X: object,
    P0: object,
    k: Nominal,
    K_V: Kernel,
    K_W: Kernel,
    discretisation: Discretisation | None = None,
) -> tuple[Tensor, Tensor]:
    """Algorithm 2, LR calibration, online part: k1 and Dk1 at new configurations by (20), (21).

    Args:
        xi: (M, n) configurations, rad or m.
        X, P0, k, K_V, K_W: what :func:`lr_calibration` returned.
        discretisation: the same as for :func:`lr_calibration`; the tuple does not contain it.

    Returns:
        k1 (M, m) in m, and Dk1 (M, m, n) transported by (20), which differs from the derivative of k1 by some per cent
        (erratum 2).

    Raises:
        InputError: wrong shapes or values.
        NumericalError: the flow overflows.
    """
    equations, integrator = discretisation or Discretisation()
    X = as_tensor(X, "X", ("N", "n"))
    P0 = as_tensor(P0, "P0", (len(X), "m"), fix="pass what `lr_calibration` returned")
    check_kernel(K_V, X.shape[1], "K_V")
    check_kernel(K_W, P0.shape[1], "K_W")
    at = as_tensor(xi, "xi", ("M", X.shape[1]), empty=True)
    model = ModelSpec(as_nominal(k), K_V, K_W, X.new_zeros(0), P0.shape[1])
    momenta = Momenta(X[:0], P0, X.new_zeros(0))
    k1 = EulerianDeformation(model, X, momenta, integrator, equations)  # Solve ODEs (17)
    found = k1(at), k1.jacobian(at)  # Solve ODEs (20); (k_1(xi), Dk_1(xi))
    check_finite(found[0], "k(xi)")
    return found
