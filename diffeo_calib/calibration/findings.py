"""Findings of a calibration: how much each part of the model explains, which rows are outliers, and why."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import LIMITS as SCALE_LIMITS
from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.quantiles import above_estimated, chi2_above, chi2_median, known, largest_known
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.transmission import gear_lines
from diffeo_calib.maps.deformation import Deformation
from diffeo_calib.measurements.rows import REPEAT_TOLERANCE
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.coordinates import errors_of_kinds

MOST_CONFIGURATIONS = 8000
"""Configurations on which the parts of a model are measured."""
FAR = "far from where the other rows predict it"
MAX_MARKERS_FOR_EXCHANGE = 12
"""Number of markers up to which exchanged pairs are looked for."""


@dataclass(frozen=True)
class Outlier:
    """A measurement that deviates from its prediction by more than noise explains.

    Args:
        row: number of the row in the measurements.
        marker: number of the marker; None if there is only one, or if poses were measured.
        tip: name of the tip, of poses on several; else None.
        number: line of the row in its file, see :attr:`Measurements.line_numbers`.
        distance: from its prediction by all other rows, m; of readings in m at the tool.
        weight: its weight in the fit, about 1 for inliers; None if it took no part in the fit.
        reason: probable cause, in words.
        reading: what a reading is off by in its own unit, and this unit; None for measured positions.
    """

    row: int
    marker: int | None
    number: int
    distance: float
    weight: float | None
    reason: str
    tip: str | None = None
    reading: tuple[float, str] | None = None

    @property
    def shown(self) -> tuple[float, str]:
        """Size of the error, and its unit."""
        return self.reading or (1e3 * self.distance, "mm")


@dataclass(frozen=True)
class Part:
    """One part of the model and its effect.

    Args:
        name: such as "geometry", "transmission of joint_2", "gravity on joints".
        displacement: RMS displacement of the markers by this part over the measured configurations, m.
        angle: RMS error of the joint for the transmission of a joint, rad (m for a slide); None for other parts.
    """

    name: str
    displacement: float
    angle: float | None = None


def parts(model: CalibratedKinematics) -> list[Part]:
    """How much each part of a model explains, to first order in the deformations; parts may cancel each other.

    Of many configurations a part is looked at, evenly spread over the table.

    The mean of a joint's transmission error over the configurations is equivalent to a joint offset and counts as
    geometry.
    """
    deformation = model.map.deformation
    by_row = deformation.spec.at_controls
    nominal = by_row if isinstance(by_row, GeometryMap) else model.nominal  # each row has its own payload
    x, theta = model.configurations, deformation.momenta.theta
    rows = torch.arange(0, len(x), -(-len(x) // MOST_CONFIGURATIONS), device=x.device)
    nominal, x = nominal.rows(rows), x[rows]
    errors, coefficients = nominal.split(theta)
    jacobian = nominal.jacobian(x, theta)
    joints, offsets = _joint_parts(model, x, jacobian)
    registered, refined = nominal.geometry.points(x), nominal.geometry.points(x, errors)
    found = [Part("geometry", _rms((refined - registered).flatten(1) + jacobian @ offsets))]
    if nominal.elasticity is not None:
        effects = nominal.sensitivities(x, theta)[..., nominal.sag] * coefficients
        found += [Part(name, _rms(effects[..., own].sum(-1))) for name, own in nominal.elasticity.parts.items()]
    joints += [Part(f"gear line {line.frequency:.1f} of {line.joint}", line.displacement) for line in gear_lines(model)]
    return [*found, *joints, Part("task space", _task_part(deformation, x))]


def _joint_parts(model: CalibratedKinematics, x: Tensor, jacobian: Tensor) -> tuple[list[Part], Tensor]:
    """Transmission of every joint, then the coupled joint errors; and the transmissions' means (n,)."""
    deformation = model.map.deformation
    found, coupled, means = [], torch.zeros_like(jacobian[..., 0]), torch.zeros_like(x[0])
    for term in deformation.spec.joint_kernel.terms:
        v = term.field(x, deformation.x, deformation.momenta.joint)
        if isinstance(term, RadialKernel) and term.output is not None:
            means = means + v.mean(0)
            varying = v - v.mean(0)
            angle = float(varying[:, term.output].square().mean().sqrt())
            moved = _rms((jacobian @ varying[:, :, None])[..., 0])
            found.append(Part(f"transmission of {model.robot.joint_names[term.output]}", moved, angle))
        else:
            coupled = coupled + (jacobian @ v[:, :, None])[..., 0]
    return [*found, Part("coupled joint errors", _rms(coupled))], means


def _task_part(deformation: Deformation, x: Tensor) -> float:
    """RMS displacement of the markers by the task-space field, m."""
    points = deformation.spec.nominal(x, deformation.momenta.theta).reshape(-1, deformation.spec.task_dim)
    start = deformation.task_controls
    return _rms(deformation.spec.task_kernel.field(points, start, deformation.momenta.task))


def _rms(displacements: Tensor) -> float:
    """Root mean square length of displacements, coordinates in triples, m."""
    return float(displacements.reshape(-1, 3).square().sum(-1).mean().sqrt())


def outliers(
    model: CalibratedKinematics, placed: Any, tangent_data: TangentData, left_out: LeaveOneOut
) -> list[Outlier]:
    """Measurements further from their prediction than noise explains, the worst first.

    Args:
        model: the calibrated model, which helps to find the causes.
        placed: the rows, as :func:`placing.place.place` finds them. tangent_data: the same, with their weights.
        left_out: their leave-one-out errors.
    """
    noise, weights, squares = tangent_data.noise_model, tangent_data.tails.weights, left_out.squares
    least = gates.UNCHOSEN_FACTOR if len(squares) < SCALE_LIMITS.fewest_poses else 1.0
    bad = excluded_by_others(squares, noise.of_freedom(float, squares), least)
    each = left_out.errors.unflatten(1, (noise.bodies, -1))
    distances = each.nan_to_num(0.0).norm(dim=2) if noise.size % 3 else each.unflatten(2, (-1, 3)).mean(2).norm(dim=2)
    found = []
    if placed.coordinates is not None:
        table, rows = placed.coordinates
        own = found_outliers(model, table, bad[rows], distances[rows], weights[rows])
        found += [replace(one, row=int(rows[one.row])) for one in own]
    for one in placed.readings:
        sizes = each[one.rows, 0].nan_to_num(0.0).norm(dim=1)
        shown = errors_of_kinds(left_out.errors, None, [one]).main
        unit, per_unit = shown.shown
        for number in bad[one.rows, 0].nonzero()[:, 0].tolist():
            row, line = int(one.rows[number]), int(one.data.lines[number])
            reading = per_unit * float(shown.errors[number, 0]), unit
            found.append(Outlier(row, None, line, float(sizes[number]), float(weights[row, 0]), FAR, reading=reading))
    return sorted(found, key=lambda outlier: -outlier.distance)


def excluded(squares: Tensor, freedom: int, factor: float = 1.0) -> Tensor:
    """Which squared distances (N, bodies), chi-squared, are too large by chance, or beside most of the others.

    Args:
        factor: by which an error must exceed what chance explains.
    """
    seen = known(squares)
    size = max(1.0, float(seen.median()) / chi2_median(freedom))
    return squares > factor**2 * size * chi2_above(gates.OUTLIER_CHANCE / len(seen), freedom)


def excluded_by_others(squares: Tensor, freedom: Tensor, least: float = 1.0) -> Tensor:
    """Which squared distances (N, bodies) are too large where the others tell how large errors are.

    In units of a variance that is estimated from n numbers, the largest square of clean rows is that of an F ratio and
    not of chi-squared: twice as large with n = 30. Their median knows the variance half as well as all of them.

    Args:
        freedom: (N, bodies) of each. least: smallest size of the errors in units of what the model expects.
    """
    seen, level = ~squares.isnan(), gates.OUTLIER_CHANCE / len(known(squares))
    kinds = freedom[seen].unique().tolist()
    size = torch.cat([squares[seen & (freedom == k)] / chi2_median(k) for k in kinds]).median()
    lower, limits = gates.MEDIAN_EFFICIENCY * float(freedom[seen].sum()), torch.zeros_like(squares)
    for k in kinds:
        limits[freedom == k] = above_estimated(level, k, lower)
    return squares > size.clamp(min=least) * limits


def found_outliers(
    model: CalibratedKinematics, data: Measurements, bad: Tensor, distances: Tensor, weights: Tensor | None = None
) -> list[Outlier]:
    """Wrong measurements with their probable causes, the worst first.

    Args:
        model: the calibrated model. data: the measurements. bad: (N, bodies) which of them are wrong.
        distances: (N, bodies) from their predictions, m. weights: (N, bodies) in the fit, if they took part in it.
    """
    if not bool(bad.any()):
        return []
    labels = data.bodies.labels(data, model.on)
    data = data if labels[0][1] is None else data.with_tips([str(tip) for _, tip in labels])
    predicted = model.at_payloads(data.payload)(data.q).detach()
    found = [
        Outlier(
            row,
            labels[body][0],
            int(data.line_numbers[row]),
            float(distances[row, body]),
            None if weights is None else float(weights[row, body]),
            _reason(row, body, data, predicted, bad),
            labels[body][1],
        )
        for row, body in bad.nonzero().tolist()
    ]
    return sorted(found, key=lambda outlier: -outlier.distance)


def _reason(row: int, body: int, data: Measurements, predicted: Tensor, bad: Tensor) -> str:
    """Probable cause of an outlier, in words."""
    own = (predicted[row] - data.points[row]).norm(dim=-1)
    small = gates.REMAINING_ERROR * float(known(own).max())
    seen = data.seen_bodies
    others = [k for k in range(bad.shape[1]) if k != body and bool(seen[row, k])]
    other = _exchanged_with(row, body, data, predicted, small)
    if other is not None:
        return f"markers {body} and {other} seem to be exchanged"
    if others and not bool(bad[row, others].any()):
        return f"{data.body_names[body]} alone is off, the other {data.bodies.many} of this row fit"
    in_socket = data.other_socket(row, predicted, small)
    if in_socket is not None:
        return in_socket
    elsewhere = largest_known((predicted - data.points[row]).norm(dim=-1))
    elsewhere[row] = torch.inf
    nearest = int(elsewhere.argmin())
    if float(elsewhere[nearest]) < small:
        return f"fits the configuration of row {int(data.line_numbers[nearest])}: a wrong pairing?"
    repeats = ((data.q - data.q[row]).abs() <= REPEAT_TOLERANCE).all(1)
    repeats[row] = False
    if bool(repeats.any()) and not bool(bad[repeats].any()):
        return "repeated measurements of this pose agree with the model, so this one is probably wrong"
    return FAR


def _exchanged_with(row: int, body: int, data: Measurements, predicted: Tensor, small: float) -> int | None:
    """The marker with which marker ``body`` of a row seems to be exchanged, if any."""
    if data.seen_bodies.shape[1] > MAX_MARKERS_FOR_EXCHANGE:
        return None
    for other in data.bodies.exchangeable(data):
        errors = (predicted[row, [body, other]] - data.points[row, [other, body]]).norm(dim=-1)
        if other != body and float(errors.max()) < small:
            return other
    return None
