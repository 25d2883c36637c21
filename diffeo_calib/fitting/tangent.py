"""The tangent model: calibration as Gaussian-process regression.

To first order k1 = k0 + Dk0 K_V b + K_W p + S theta: a Gaussian process with the prior covariance

    G(x, x') = Dk0(x) K_V(x, x') Dk0(x')^T + K_W(k0(x), k0(x')) + S(x) Lambda^-1 S(x')^T

Conditioned on the data it gives the momenta, the marginal likelihood and exact leave-one-out errors. The
same linear algebra around a deformation instead of zero is one Gauss-Newton step.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

from torch import Tensor

from diffeo_calib.fitting.objective import Objective
from diffeo_calib.flows.integrators import RK4
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.regression.choose import LinearSolver, condition, condition_controls
from diffeo_calib.regression.conditional import Conditional
from diffeo_calib.regression.conjugate_gradients import CG_TOLERANCE


@dataclass(frozen=True)
class Regression:
    """A linearisation conditioned on its data.

    Args:
        conditional: the linearisation, conditioned by one of the methods in regression/.
        target: (N, m) measured minus linearised model at zero fields, m.
    """

    conditional: Conditional
    target: Tensor

    def momenta(self) -> Momenta:
        """Posterior mode of b, p, theta."""
        return self.conditional.momenta(self.target)


def regress(
    problem: Objective[GeodesicDeformation],
    deformation: GeodesicDeformation,
    linear: LinearSolver = "auto",
    tolerance: float = CG_TOLERANCE,
) -> Regression:
    """Linearise a problem around a deformation and condition it on its data, which are its control points.

    Args:
        problem: data, noise, control points.
        deformation: a deformation of this problem.
        linear: "cholesky" of G + R, conjugate gradients "cg", or "auto" by size.
        tolerance: of conjugate gradients, relative residual.

    Raises:
        InputError: the method needs more memory than is free.
        NumericalError: G + R is not positive definite in float64.
    """
    slopes = problem.slopes(deformation)
    lin = deformation.linearise()
    response = deformation.linear_response(lin)
    if slopes is not None:
        lin, response = lin.projected(slopes), (slopes @ response[:, :, None])[:, :, 0]
    target = problem.y - problem.values(deformation) + response
    return Regression(condition(lin, problem.noise, linear, tolerance), target)


def linear_optimum(
    problem: Objective[GeodesicDeformation],
    deformation: GeodesicDeformation,
    linear: LinearSolver = "auto",
    tolerance: float = CG_TOLERANCE,
) -> tuple[Momenta, float]:
    """The momenta that minimise the energy of a problem linearised around a deformation; arguments as of `regress`.

    Problems with fewer control points than data are solved by their normal equations.

    Returns:
        the momenta; how far the energy of the linearised problem falls to them, NaN if the data are the controls.
    """
    if not problem.reduced:
        return regress(problem, deformation, linear, tolerance).momenta(), nan
    slopes = problem.slopes(deformation)
    return condition_controls(deformation, problem.x, problem.noise, slopes, problem.residual).mode()


def tangent(problem: Objective[GeodesicDeformation], linear: LinearSolver = "auto") -> Regression:
    """The tangent model at zero deformation."""
    return regress(problem, problem.deform(problem.zero(), RK4(1)), linear)
