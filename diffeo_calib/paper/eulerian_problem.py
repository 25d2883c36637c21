"""The fitting problem in the paper's formulation: find P0 that minimises (16) subject to (17), (19).

(R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025.)
A descent starts with a few steps of shooting at the end condition (12), R P_1 = y - k1. The matrix of the tangent
model replaces the sensitivities, which have no closed form here:

    P0 <- P0 + (G + R)^-1 (y - k1 - R P_1)

The first step from zero is the tangent solution. Shooting continues as long as the energy falls, on the RR test bed
for five steps, from E = 1.8e4 to 0.066. (More would diverge, since G does not depend on the deformation.) With the
printed sign v works against w, so that the tangent step raises the energy and the descent starts at zero. It still
fits where one kernel dominates, but slowly: on the test bed to E = 0.0593 in 766 evaluations, where the corrected sign
needs 68 to reach 0.0574.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

from diffeo_calib.common.errors import InputError, NumericalError, as_written, sentence
from diffeo_calib.fitting.objective import Objective, Start
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.fitting.tangent import tangent
from diffeo_calib.flows.integrators import RK4, Integrator
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.paper.eulerian_flow import Eulerian
from diffeo_calib.paper.eulerian_model import EulerianDeformation
from diffeo_calib.regression.cholesky import CholeskyRegression
from diffeo_calib.regression.conditional import Conditional

MAX_SHOTS = 20
"""Largest number of shooting steps; few suffice where shooting converges."""
SHORTEST_SHOT = 0.5
"""Smallest fraction of a shooting step that is tried."""


class EulerianProblem(Objective[EulerianDeformation]):
    """A problem's data, kernels and noise under the paper's equations; the unknown is P0 alone.

    Args:
        exact: the problem in the exact formulation.
        equations: the errata to keep; by default those of :class:`Eulerian`.

    Raises:
        InputError: fewer control points than data, or a problem with ``observe``.
    """

    def __init__(self, exact: Problem, equations: Eulerian | None = None) -> None:
        if exact.reduced:
            raise InputError(_NO_CONTROLS)
        if exact.observe is not None:
            fix = 'leave `observe` out, or pass formulation="exact"'
            raise InputError.of("`observe` in the Eulerian formulation", expected="measured coordinates", fix=fix)
        self.exact, self.equations = exact, checked_equations(equations)
        self.spec, self.x, self.y, self.noise = exact.spec, exact.x, exact.y, exact.noise
        self.controls, self.reduced, self.new_noise = exact.controls, False, exact.new_noise
        self.certified = False

    @classmethod
    def with_errata(cls, exact: Problem, switches: Mapping[str, object]) -> EulerianProblem:
        """The problem with selected errata kept as printed.

        Args:
            exact: the problem in the exact formulation.
            switches: arguments of :class:`Eulerian` by name.

        Raises:
            InputError: an unknown switch, or fewer control points than data.
        """
        known = list(Eulerian.__dataclass_fields__)
        unknown = [name for name in switches if name not in known]
        if unknown:
            expected = f"{', '.join(known)} of the Eulerian formulation"
            raise InputError.of("keywords of `fit`", expected=expected, got=", ".join(unknown))
        return cls(exact, Eulerian(**switches))  # pyright: ignore[reportArgumentType]

    def zero(self) -> Momenta:
        """P0 = 0: k1 = k0."""
        return self.unknowns(self.exact.zero())

    def unknowns(self, momenta: Momenta) -> Momenta:
        """P0 and theta; b is implied."""
        return Momenta(momenta.joint[:0], momenta.task, momenta.theta)

    def deform(self, momenta: Momenta, integrator: Integrator) -> EulerianDeformation:
        """Solve (17) and (19) for these momenta."""
        return EulerianDeformation(self.spec, self.x, momenta, integrator, self.equations)

    def preconditioner(self, momenta: Momenta, integrator: Integrator) -> CholeskyRegression:
        """G + R of the tangent model, for any momenta."""
        return self._factor

    @cached_property
    def _factor(self) -> CholeskyRegression:
        known = self._conditional
        return known if isinstance(known, CholeskyRegression) else self.exact.preconditioner(self.exact.zero(), RK4(1))

    @cached_property
    def _conditional(self) -> Conditional:
        return tangent(self.exact).conditional

    def start(self, integrator: Integrator) -> Start:
        """Shoot at (12) from P0 = 0 as long as the energy falls."""
        at, evaluations = self.zero(), 1
        deformation = self.deform(at, integrator)
        best = float(self.energy(deformation).total)
        for _ in range(MAX_SHOTS):
            end = deformation.end_momenta.view_as(self.y)  # P_1
            miss = self.y - deformation.z1 - self.noise.multiply(end[:, :, None])[:, :, 0]
            change = self.unknowns(self._conditional.momenta(miss))
            step, found = 1.0, None
            while found is None and step >= SHORTEST_SHOT:
                trial = at.unflatten(at.flatten() + step * change.flatten())
                found, evaluations, step = self._better(trial, integrator, best), evaluations + 1, 0.5 * step
            if found is None:
                break
            at, (deformation, best) = trial, found
        return Start(at, evaluations)

    def _better(self, at: Momenta, integrator: Integrator, best: float) -> tuple[EulerianDeformation, float] | None:
        """The deformation of these momenta and its energy; None unless the energy is below ``best``."""
        try:
            deformation = self.deform(at, integrator)
        except NumericalError:
            return None
        value = float(self.energy(deformation).total)
        return (deformation, value) if value < best else None


_NO_CONTROLS = sentence(
    "the Eulerian formulation has a momentum at every measurement: fewer `controls` are not possible",
    fix='leave `controls` out, or pass formulation="exact"',
)


def checked_equations(equations: Eulerian | None) -> Eulerian:
    """``equations``, or the default :class:`Eulerian`.

    Raises:
        InputError: not an :class:`Eulerian`.
    """
    if equations is not None and not isinstance(equations, Eulerian):
        expected = "an Eulerian(...) of diffeo_calib.paper.eulerian_flow"
        raise InputError.of("`equations`", expected=expected, got=as_written(equations))
    return equations or Eulerian()
