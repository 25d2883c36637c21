"""The paper's formulation for tests: variants of its equations and a small problem."""

from itertools import product

from math_bank import K_V, K_W, normal, uniform
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.paper.eulerian import Eulerian, EulerianDeformation, EulerianProblem
from diffeo_calib.robots import elastic_rr

SWITCHES = [Eulerian(*flags) for flags in product((False, True), repeat=3)]
CORRECTED = Eulerian(printed_jacobian=False)


def name(equations: Eulerian) -> str:
    return "-".join(s for s, on in vars(equations).items() if on) or "corrected"


def momenta(p0: Tensor) -> Momenta:
    return Momenta(p0.new_zeros(0, 2), p0, p0.new_zeros(0))


def small_problem(count: int = 7) -> dc.Problem:
    x = uniform(count, 2, seed=3)
    return dc.Problem(elastic_rr.nominal, x, elastic_rr.real(x), joint_kernel=K_V, task_kernel=K_W, noise=0.1)


def deformed(
    p0: Tensor, equations: Eulerian | None = None, integrator: Integrator | None = None
) -> EulerianDeformation:
    return EulerianProblem(small_problem(len(p0)), equations).deform(momenta(p0), integrator or dc.RK4(2))


P0 = 0.03 * normal(7, 2, seed=5)
