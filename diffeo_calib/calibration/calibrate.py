"""`calibrate`: from a robot and measurements to calibrated kinematics, everything chosen from the data.

    1 registration   base frame and markers, six plus three per marker unknowns
    2 geometry       an error twist before every joint, with a prior; outliers lose their influence
    3 scales         of kernels, priors and noise, by marginal likelihood; then the weights of outliers, and again
    4 diffeomorphic  phi, psi, geometry and deflection under gravity together, fitted exactly

Each stage is kept, so that a report can show what it brought.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
from typing import Literal

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.moved_devices import warn_of_breaks
from diffeo_calib.calibration.diagnostics.plausibility import (
    check_deviations,
    check_identification,
    check_joints,
    check_limits,
    doubt_outliers,
    registered,
)
from diffeo_calib.calibration.findings import Outlier, Part, outliers, parts
from diffeo_calib.calibration.identification.identification import Identification, identify
from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters, defaults
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut, estimate_tails, leave_one_out
from diffeo_calib.calibration.scales.selection import Selection, select
from diffeo_calib.calibration.scales.sensor import Sensor
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.common.checks import check_count
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, sentence
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.fitting.result import Fit, Progress, silent
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import evaluate
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.choose import MAX_DENSE
from diffeo_calib.robots.chain import Chain

UNDECIDED = 0.3
"""Share of the registration's residual that counts as noise where geometry has more unknowns than data."""
FEWEST_POSES = 12
"""Different poses below which scales are not selected: the data cannot tell them apart."""
FEW_CONTROLS = 200
"""Configurations that carry momenta where there are too many for one dense matrix."""
FEWEST_DOUBTED = 30
"""Poses below which leave-one-out errors say nothing about the scales."""
TOLERANCE = 1e-5
"""Of coupling and end residual: what is left is far below the noise."""
ADVICE = "judge it by held-out errors, and if they are poor, measure more poses or pass fewer `controls`"
"""To users of a fit that did not converge: solver and time steps are not theirs to choose."""
CONTRADICTION = 2.5
"""Factor between predicted and leave-one-out variances from which the scales are doubted."""


@dataclass(frozen=True, repr=False)
class CalibrationResult:
    """A calibration, stage by stage.

    Attributes:
        model: the calibrated kinematics.
        registration: base and markers only. identification: full geometry, the classical baseline.
        selection: the scales of kernels, priors and noise, and how they were chosen.
        tails: how heavy the tails of the noise are, and the weight of every measurement.
        leave_one_out: errors at every configuration predicted from the others, in closed form.
        parts: how much each part of the model explains. outliers: measurements that the others contradict.
        fit: the exact model's fit with its certificates.
        stages: the kinematics of every stage by name, to compare them; status: how it ended, in one sentence.
    """

    model: CalibratedKinematics
    registration: Identification
    identification: Identification
    selection: Selection
    tails: Tails
    leave_one_out: LeaveOneOut
    parts: list[Part]
    outliers: list[Outlier]
    fit: Fit

    def __repr__(self) -> str:
        return f"CalibrationResult({self.model!r}: {self.status})"

    @property
    def stages(self) -> dict[str, Callable[[Tensor], Tensor]]:
        """Name of each stage -> its kinematics, (N, n) -> (N, P, 3) in m."""
        return {
            "nominal + registration": self.registration.geometry.points,
            "geometry": self.identification.geometry.points,
            "diffeomorphic": self.model,
        }

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C cut the work short; the model is then the best state so far."""
        return self.fit.solution.interrupted or self.selection.interrupted

    @property
    def status(self) -> str:
        """How the fit ended, in one sentence."""
        if self.selection.interrupted and not self.fit.solution.interrupted:
            what = "interrupted in the search for scales, the best so far are kept"
            return f"{what}; fitted with them: {self.fit.status}"
        return f"{self.fit.status}; scales: {self.selection.status}"


def calibrate(
    robot: Chain,
    measurements: Measurements,
    *,
    hyperparameters: Hyperparameters | None = None,
    controls: int | Literal["auto", "all"] = "auto",
    backend: Backend = "auto",
    seed: int = 0,
    progress: Progress = silent,
) -> CalibrationResult:
    """Calibrate a robot's kinematics.

    Args:
        robot: nominal chain, n joints.
        measurements: N configurations (rad, m) with P markers each (m) or with poses, in the frame of the measuring
            device; base frame and places on the tool are unknown and found. Standard deviations that come with
            them are used; what they leave unexplained is estimated.
        hyperparameters: scales of kernels and noise; chosen by marginal likelihood if not given.
        controls: how many of the configurations carry momenta, or "all"; "auto" is all up to 8000 measured
            coordinates and 200 beyond that, which is as accurate there and takes minutes instead of hours.
        backend: what runs kernel sums, see :func:`fit`.
        seed: draws the poses on which the scales are selected.
        progress: called as ``progress(task, done, total)``; Ctrl-C keeps the best state so far.

    Returns:
        a :class:`CalibrationResult`; ``result.model`` is the calibrated kinematics.

    Raises:
        MeasurementError: joints that do not match the robot, too few rows, units that cannot be
            right, or measurements that do not belong to these configurations.
        RobotError: joint names in another order than the robot's.

    Warns:
        DiffeoCalibWarning: a joint never moves, or moves far beyond its limits; too few poses to select scales; most
            rows are further than 3 % of the markers' spread from a geometric calibration; leave-one-out errors
            contradict the scales; the device, the base or a marker seems to have moved during the session;
            zeros of joints are far from the robot's description; more than 40 % of the rows contradict the others.
    """
    _check_arguments(robot, measurements, hyperparameters)
    check_joints(robot, measurements)
    if isinstance(controls, str) and controls not in ("auto", "all"):
        raise InputError(sentence("`controls`", expected="a number, 'auto' or 'all'", got=repr(controls)))
    if not isinstance(controls, str):
        check_count(controls, "`controls`", most=len(measurements))
    progress("registration", 0, 1)
    registration = registered(robot, measurements)
    progress("geometry", 0, 1)
    identification = identify(registration.geometry, measurements.q, measurements.points)
    check_identification(measurements, identification)
    check_deviations(measurements, registration)
    check_limits(robot, measurements)
    evidence = _evidence(measurements, registration, identification)
    stages = registration, identification
    selection, evidence = _scales(evidence, *stages, measurements, given=hyperparameters, seed=seed, progress=progress)
    left_out = leave_one_out(evidence, selection.scales, seed)
    _doubt(evidence, left_out)
    if hyperparameters is None:
        widening = left_out.uncertainty(_configurations(measurements)) ** 0.5
        selection = replace(selection, scales=selection.scales.widened(widening))
        left_out = leave_one_out(evidence, selection.scales, seed)
    problem = _problem(evidence, selection.scales)
    count = _controls(controls, evidence)
    start = replace(problem.zero(), theta=evidence.theta) if count is None else None
    solver = GaussNewton(tolerance=TOLERANCE)
    fitted = fit(problem, solver, controls=count, backend=backend, start=start, progress=progress)
    fitted = replace(fitted, advice=ADVICE)
    model = CalibratedKinematics(robot, fitted.model, {}, lever=measurements.lever)
    found = outliers(model, measurements, evidence, left_out)
    doubt_outliers(len({one.row for one in found}), measurements, found[0].reason if found else "")
    result = CalibrationResult(
        model, registration, identification, selection, evidence.tails, left_out, parts(model), found, fitted
    )
    model.report.update(_summary(result, measurements))
    return result


def _check_arguments(robot: object, measurements: object, hyperparameters: object) -> None:
    """Raise InputError for arguments of the wrong kind."""
    kinds = ((robot, "robot", Chain), (measurements, "measurements", Measurements))
    for given, name, kind in (*kinds, (hyperparameters, "hyperparameters", Hyperparameters)):
        if not isinstance(given, kind) and not (name == "hyperparameters" and given is None):
            raise InputError(sentence(f"`{name}`", expected=f"a dc.{kind.__name__}", got=type(given).__name__))
    if isinstance(hyperparameters, Hyperparameters) and isinstance(robot, Chain):
        got = len(hyperparameters.transmission_amplitude), len(hyperparameters.compliance)
        if got != (robot.n, robot.moving):
            expected = f"scales of {robot.n} joints, {robot.moving} of them moving"
            raise InputError(sentence("`hyperparameters`", expected=expected, got=f"{got[0]} and {got[1]}"))


def _evidence(data: Measurements, registration: Identification, identification: Identification) -> TangentData:
    """The measurements around the geometric calibration, their weights those of its residuals."""
    nominal = GeometryMap(registration.geometry, elastic=True)
    undeflected = torch.zeros(nominal.parameters - nominal.geometry.size, dtype=torch.float64)
    theta = torch.cat([identification.theta, undeflected])
    sensor = Sensor.of(data, identification.noise)
    weights = identification.tails.weights
    weights = weights if sensor.bodies == data.markers else weights.amin(1, keepdim=True)
    tails = replace(identification.tails, weights=weights)
    return TangentData(nominal, theta, data.q, data.points.flatten(1), sensor, tails)


def _scales(
    evidence: TangentData,
    registration: Identification,
    identification: Identification,
    data: Measurements,
    *,
    given: Hyperparameters | None,
    seed: int,
    progress: Progress,
) -> tuple[Selection, TangentData]:
    """Scales and weights: given, or by marginal likelihood, or defaults where the data cannot tell them apart."""
    noise, count = identification.noise, _configurations(data)
    if count * evidence.y.shape[1] <= evidence.nominal.geometry.size:
        noise = max(noise, UNDECIDED * registration.noise)  # geometry can fit these data exactly: it says nothing
    if given is not None:
        return Selection(given, "given"), replace(evidence, tails=estimate_tails(evidence, given, seed))
    centre = defaults(
        evidence.nominal, evidence.theta, evidence.x, noise, prior=identification.prior, space=evidence.space
    )
    if count < FEWEST_POSES:
        poses = f"{count} poses" if count == len(data) else f"{count} different poses"
        text = f"{poses} are too few to select scales: defaults are used"
        fix = f"measure at least {FEWEST_POSES} poses, better 60; trust held-out errors only"
        warnings.warn(sentence(text, fix=fix), DiffeoCalibWarning, stacklevel=3)
        return Selection(centre, f"defaults, since {poses} are too few to select them"), evidence
    first = select(centre, evidence, seed=seed, progress=progress)
    evidence = replace(evidence, tails=estimate_tails(evidence, first.scales, seed))
    if first.interrupted:
        return first, evidence
    second = select(centre, evidence, start=first.scales, seed=seed, progress=progress)
    interrupted = second.interrupted or warn_of_breaks(data.line_numbers, evidence, centre, second, seed)
    second = replace(second, interrupted=interrupted)
    jacobian = evidence.nominal.jacobian(evidence.x, evidence.theta)
    scales = second.scales.supported(jacobian, evidence.sensor.covariance(second.scales, jacobian))
    evidence = replace(evidence, tails=estimate_tails(evidence, scales, seed))
    return replace(second, scales=scales), evidence


def _configurations(data: Measurements) -> int:
    """How many there are: repeats tell noise, nothing about the robot."""
    return int(data.groups().max()) + 1


def _controls(given: int | Literal["auto", "all"], evidence: TangentData) -> int | None:
    """How many configurations carry momenta; None for all."""
    rows = len(evidence.x)
    if given == "all":
        return None
    if given == "auto":
        return FEW_CONTROLS if evidence.y.numel() > MAX_DENSE and rows > FEW_CONTROLS else None
    return given


def _problem(evidence: TangentData, scales: Hyperparameters) -> Problem:
    """The exact model's problem."""
    nominal, sensor = evidence.nominal, evidence.sensor
    noise = sensor.covariance(scales, nominal.jacobian(evidence.x, evidence.theta))
    return Problem(
        nominal,
        evidence.x,
        evidence.y,
        joint_kernel=scales.joint_kernel(evidence.space),
        task_kernel=scales.task_kernel(),
        noise=sensor.weighted(noise, evidence.tails),
        markers=sensor.markers,
        prior_variance=scales.prior_variance(nominal),
        new_noise=_new_noise(evidence, scales),
    )


def _new_noise(evidence: TangentData, scales: Hyperparameters) -> Tensor:
    """Covariance (m, m) of a new measurement: heavy tails widen it so that its 95 % region holds 95 %."""
    from scipy.stats import chi2, f  # noqa: PLC0415  # slow to import, not needed to use a model

    jacobian = evidence.nominal.jacobian(evidence.x, evidence.theta)
    mean = evidence.sensor.covariance(scales, jacobian).mean(0)
    freedom, k = evidence.tails.freedom, evidence.sensor.freedom
    if freedom == inf:
        return mean
    return mean * float(k * f.ppf(0.95, k, freedom) / chi2.ppf(0.95, k))


def _doubt(evidence: TangentData, left_out: LeaveOneOut) -> None:
    """Warn if leave-one-out errors are not what the scales predict."""
    from scipy.stats import chi2  # noqa: PLC0415

    # Medians: outliers have their own report. Few rows say nothing.
    ratio = float(left_out.squares.median()) / float(chi2.median(evidence.sensor.freedom))
    # Too wide is careful, and what outliers do, unless the deviations were given.
    overstated = evidence.sensor.known is not None and ratio < 1 / CONTRADICTION
    if len(evidence.x) >= FEWEST_DOUBTED and (overstated or ratio > CONTRADICTION):
        fix = "trust held-out errors, not the predicted deviations; measure more poses"
        if overstated:
            fix = "the given standard deviations are larger than the errors: check `std` and its unit"
        text = sentence(
            "leave-one-out errors contradict the selected scales",
            expected="squared errors of the predicted variance",
            got=f"{ratio:.2g} times that",
            fix=fix,
        )
        warnings.warn(text, DiffeoCalibWarning, stacklevel=3)


def _summary(result: CalibrationResult, data: Measurements) -> dict[str, float | int | str]:
    """What travels with the model."""
    report: dict[str, float | int | str] = {
        "registration rms [m]": evaluate(result.registration.geometry.points, data).rms,
        "geometry rms [m]": evaluate(result.identification.geometry.points, data).rms,
        "diffeomorphic rms [m]": evaluate(result.model, data).rms,
        "leave-one-out rms [m]": float(
            result.leave_one_out.errors.unflatten(1, (-1, 3)).square().sum(-1).mean().sqrt()
        ),
        "outliers": len(result.outliers),
        "noise degrees of freedom": "infinite" if result.tails.freedom == inf else result.tails.freedom,
        "coupling residual": result.fit.coupling_residual,
        "end residual": result.fit.end_residual,
        "energy": result.fit.energy,
        "status": result.fit.status,
        "scales": result.selection.status,
        "rows": len(data),
    } | {f"{part.name} [m]": part.displacement for part in result.parts}
    if result.leave_one_out.effective is not None:
        report["effective parameters"] = result.leave_one_out.effective
    return report
