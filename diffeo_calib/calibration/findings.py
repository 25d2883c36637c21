"""What a calibration found: how much each part explains, which rows look wrong and why, and a page of text."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.maps.deformation import Deformation
from diffeo_calib.measurements.table import REPEAT_TOLERANCE, Measurements

FALSE_ALARM = 0.01
"""Probability that any row of clean Gaussian data is flagged."""
EXPLAINS = 0.2
"""A guess at what went wrong is told if it leaves less than this part of the row's error."""
MOST_MARKERS = 12
"""Markers up to which exchanged pairs are looked for."""


@dataclass(frozen=True)
class Outlier:
    """A measurement that the others contradict.

    Args:
        row: number of the row in the measurements.
        marker: number of the marker; None if there is only one, or if poses were measured.
        number: where the row is from: its line in the file, see :attr:`Measurements.line_numbers`.
        distance: from where the others predict it, m.
        weight: its weight in the fit, about 1 for good measurements.
        reason: what looks wrong, in words.
    """

    row: int
    marker: int | None
    number: int
    distance: float
    weight: float
    reason: str


@dataclass(frozen=True)
class Part:
    """One part of the model and what it does.

    Args:
        name: such as "geometry", "transmission of joint_2", "gravity on joints".
        displacement: RMS of what it moves the markers by, over the measured configurations, m.
        angle: RMS error of the joint that it stands for, rad (m for a slide); None where it is not one joint's.
    """

    name: str
    displacement: float
    angle: float | None = None


def parts(model: CalibratedKinematics) -> list[Part]:
    """How much each part of a model explains, to first order in the deformations; parts may cancel each other.

    The mean of a joint's transmission over the configurations cannot be told from its zero: geometry has it.
    """
    deformation = model.map.deformation
    nominal = model.nominal
    x, theta = model.configurations, deformation.momenta.theta
    errors, coefficients = nominal.split(theta)
    jacobian = nominal.jacobian(x, theta)
    joints, zeros = _joint_parts(model, x, jacobian)
    placed, seen = nominal.geometry.points(x), nominal.geometry.points(x, errors)
    found = [Part("geometry", _rms((seen - placed).flatten(1) + jacobian @ zeros))]
    if nominal.elasticity is not None:
        effects = nominal.sensitivities(x, theta)[..., nominal.geometry.size :] * coefficients
        for own, name in ((True, "gravity on joints"), (False, "gravity on links")):
            found.append(Part(name, _rms(effects[..., nominal.elasticity.own == own].sum(-1))))
    return [*found, *joints, Part("task space", _task_part(deformation, x))]


def _joint_parts(model: CalibratedKinematics, x: Tensor, jacobian: Tensor) -> tuple[list[Part], Tensor]:
    """Transmission of every joint, then what depends on all joints; and the transmissions' means (n,)."""
    deformation = model.map.deformation
    found, coupled, zeros = [], torch.zeros_like(jacobian[..., 0]), torch.zeros_like(x[0])
    for term in _terms(deformation.spec.joint_kernel):
        v = term.field(x, deformation.x, deformation.momenta.joint)
        if isinstance(term, RadialKernel) and term.output is not None:
            zeros = zeros + v.mean(0)
            varying = v - v.mean(0)
            angle = float(varying[:, term.output].square().mean().sqrt())
            moved = _rms((jacobian @ varying[:, :, None])[..., 0])
            found.append(Part(f"transmission of {model.robot.joint_names[term.output]}", moved, angle))
        else:
            coupled = coupled + (jacobian @ v[:, :, None])[..., 0]
    return [*found, Part("coupled joint errors", _rms(coupled))], zeros


def _task_part(deformation: Deformation, x: Tensor) -> float:
    points = deformation.spec.nominal(x, deformation.momenta.theta).reshape(-1, deformation.spec.task_dim)
    start = deformation.task_controls
    return _rms(deformation.spec.task_kernel.field(points, start, deformation.momenta.task))


def _terms(kernel: Kernel) -> tuple[Kernel, ...]:
    return kernel.terms


def _rms(displacements: Tensor) -> float:
    """Root mean square length of displacements, coordinates in triples, m."""
    return float(displacements.reshape(-1, 3).square().sum(-1).mean().sqrt())


def outliers(
    model: CalibratedKinematics, data: Measurements, evidence: TangentData, left_out: LeaveOneOut
) -> list[Outlier]:
    """Measurements further from their prediction than noise explains, the worst first."""
    from scipy.stats import chi2  # noqa: PLC0415  # slow to import, not needed to use a model

    weights, squares = evidence.tails.weights, left_out.squares
    limit = float(chi2.isf(FALSE_ALARM / squares.numel(), evidence.sensor.freedom))
    flagged = (squares > limit).nonzero().tolist()
    errors = left_out.errors.unflatten(1, (-1, 3))
    distances = errors.norm(dim=-1) if evidence.sensor.modes is None else errors.mean(1, keepdim=True).norm(dim=-1)
    predicted = model(data.q).detach() if flagged else data.points
    found = [
        Outlier(
            row,
            None if evidence.sensor.modes is not None or data.markers == 1 else body,
            int(data.line_numbers[row]),
            float(distances[row, body]),
            float(weights[row, body]),
            _reason(row, body, data, predicted, squares > limit),
        )
        for row, body in flagged
    ]
    return sorted(found, key=lambda outlier: -outlier.distance)


def _reason(row: int, body: int, data: Measurements, predicted: Tensor, bad: Tensor) -> str:
    """What looks wrong with a row, in words."""
    measured, own = data.points[row], (predicted[row] - data.points[row]).norm(dim=-1)
    enough = EXPLAINS * float(own.max())
    others = [k for k in range(bad.shape[1]) if k != body]
    for other in others if data.markers <= MOST_MARKERS and data.lever is None else []:
        exchanged = (predicted[row, [body, other]] - measured[[other, body]]).norm(dim=-1)
        if float(exchanged.max()) < enough:
            return f"markers {body} and {other} seem to be exchanged"
    if others and not bool(bad[row, others].any()):
        return f"marker {body} alone is off, the other markers of this row fit"
    elsewhere = (predicted - measured).norm(dim=-1).amax(1)
    elsewhere[row] = torch.inf
    nearest = int(elsewhere.argmin())
    if float(elsewhere[nearest]) < enough:
        return f"fits the configuration of row {int(data.line_numbers[nearest])}: a wrong pairing?"
    repeats = ((data.q - data.q[row]).abs() <= REPEAT_TOLERANCE).all(1)
    repeats[row] = False
    if bool(repeats.any()) and not bool(bad[repeats].any()):
        return "its repeats agree with the model: measured wrongly"
    return "far from where the other rows predict it"
