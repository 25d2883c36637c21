"""`calibrate`: from a robot and measurements to calibrated kinematics, everything chosen from the data.

    1 registration   base frame and markers, six plus three per marker unknowns
    2 geometry       an error twist before every joint, with a prior
    3 diffeomorphic  phi and psi on top, geometry refined with them, fitted exactly

Each stage is kept, so that a report can show what it brought.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.fit import fit
from diffeo_calib.calibration.hyperparameters import Hyperparameters, Selection, defaults, select
from diffeo_calib.calibration.problem import Problem
from diffeo_calib.calibration.result import Fit, Progress, silent
from diffeo_calib.errors import DiffeoCalibWarning, MeasurementError, RobotError, sentence
from diffeo_calib.evaluation import evaluate
from diffeo_calib.measurements import Measurements
from diffeo_calib.model import CalibratedKinematics
from diffeo_calib.nominal import GeometryMap
from diffeo_calib.robots.chain import Chain
from diffeo_calib.robots.identification import Identification, Prior, identify, register
from diffeo_calib.spaces import Space

REFINE_PRIOR = Prior(translation=1e-3, rotation=1e-3, base_translation=1e-3, base_rotation=1e-3, tool=1e-3)
"""How far geometry may still move beside phi and psi, after it has converged alone. On the one robot it was
compared on, wider priors had a lower marginal likelihood, and where a joint was hardly moved they predicted worse."""
UNIT_RATIO = 30.0
"""Measured over nominal spread of the markers beyond which the length unit must be wrong."""
MISFIT = 0.25
"""Residual of the registration over the spread of the markers beyond which rows do not belong together."""
GEOMETRIC_MISFIT, DOUBTFUL_MISFIT = 0.08, 0.03
"""The same after the geometric calibration, refused and warned of: a UR10 leaves 0.001, a wrong tip link 0.1."""
UNDECIDED = 0.3
"""Share of the registration's residual that counts as noise where geometry has more unknowns than data."""
FEWEST_POSES = 12
"""Poses below which scales are not selected: the data cannot tell them apart."""


@dataclass(frozen=True, repr=False)
class CalibrationResult:
    """A calibration, stage by stage.

    Attributes:
        model: the calibrated kinematics.
        registration: base and markers only. identification: full geometry, the classical baseline.
        selection: the scales of kernels and noise, and how they were chosen.
        fit: the exact model's fit with its certificates.
        stages: the kinematics of every stage by name, to compare them; status: how it ended, in one sentence.
    """

    model: CalibratedKinematics
    registration: Identification
    identification: Identification
    selection: Selection
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
        start = "interrupted: " if self.interrupted else ""
        return f"{start}{self.fit.status}; scales: {self.selection.status}"


def calibrate(
    robot: Chain,
    measurements: Measurements,
    *,
    hyperparameters: Hyperparameters | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> CalibrationResult:
    """Calibrate a robot's kinematics.

    Args:
        robot: nominal chain, n joints.
        measurements: N configurations (rad, m) with P markers each (m), in the frame of the measuring
            device; base frame and markers on the tool are unknown and found.
        hyperparameters: scales of kernels and noise; chosen by marginal likelihood if not given.
        seed: draws the poses on which the scales are selected.
        progress: called as ``progress(task, done, total)``; Ctrl-C keeps the best state so far.

    Returns:
        a :class:`CalibrationResult`; ``result.model`` is the calibrated kinematics.

    Raises:
        MeasurementError: joints that do not match the robot, too few rows, units that cannot be
            right, or measurements that do not belong to these configurations.
        RobotError: joint names in another order than the robot's.

    Warns:
        DiffeoCalibWarning: a geometric calibration leaves more than 3 % of the markers' spread.
    """
    _check_joints(robot, measurements)
    progress("registration", 0, 1)
    registration = register(robot, measurements.q, measurements.points)
    _check_fit(robot, measurements, registration)
    progress("geometry", 0, 1)
    identification = identify(registration.geometry, measurements.q, measurements.points)
    _check_misfit(measurements, identification)
    nominal = GeometryMap(identification.geometry)
    noise = identification.noise
    if measurements.points.numel() <= identification.geometry.size:
        noise = max(noise, UNDECIDED * registration.noise)  # geometry can fit these data exactly: it says nothing
    selection = _selection(nominal, measurements, noise, given=hyperparameters, seed=seed, progress=progress)
    fitted = fit(_problem(nominal, measurements, selection.scales), progress=progress)
    model = CalibratedKinematics(robot, fitted.model, {}, lever=measurements.lever)
    model.report |= {
        "registration rms [m]": registration.rms,
        "geometry rms [m]": identification.rms,
        "diffeomorphic rms [m]": evaluate(model, measurements).rms,
        "coupling residual": fitted.coupling_residual,
        "end residual": fitted.end_residual,
        "energy": fitted.energy,
        "status": fitted.status,
        "scales": selection.status,
        "rows": len(measurements),
    }
    return CalibrationResult(model, registration, identification, selection, fitted)


def _selection(
    nominal: GeometryMap,
    data: Measurements,
    noise: float,
    *,
    given: Hyperparameters | None,
    seed: int,
    progress: Progress,
) -> Selection:
    """The scales: given, or by marginal likelihood, or defaults where the data cannot tell them apart."""
    if given is not None:
        return Selection(given, "given")
    space = Space(nominal.geometry.chain.periodic)
    scales = defaults(nominal, data.q, data.points.flatten(1), noise, space)
    if len(data) < FEWEST_POSES:
        return Selection(scales, f"defaults, since {len(data)} poses are too few to select them")
    return select(scales, _problem(nominal, data, scales), space, seed=seed, progress=progress)


def _problem(nominal: GeometryMap, data: Measurements, scales: Hyperparameters) -> Problem:
    """The exact model's problem around a converged geometry."""
    theta = torch.zeros(nominal.parameters, dtype=torch.float64)
    return Problem(
        nominal,
        data.q,
        data.points.flatten(1),
        joint_kernel=scales.joint_kernel(Space(nominal.geometry.chain.periodic)),
        task_kernel=scales.task_kernel(),
        noise=scales.noise_covariance(nominal.jacobian(data.q, theta)),
        markers=data.markers,
        prior_variance=REFINE_PRIOR.deviations(nominal.geometry).square(),
    )


def _check_joints(robot: Chain, data: Measurements) -> None:
    if data.n != robot.n:
        raise MeasurementError(
            sentence(
                f"the measurements do not fit robot '{robot.name}'",
                expected=f"{robot.n} joints ({', '.join(robot.joint_names)})",
                got=data.n,
                fix="check the base and tip links, and the joint columns",
            )
        )
    if data.joint_names is not None and tuple(data.joint_names) != tuple(robot.joint_names):
        raise RobotError(
            sentence(
                f"the measurements' joints are not those of robot '{robot.name}'",
                expected=", ".join(robot.joint_names),
                got=", ".join(data.joint_names),
                fix="put the columns in the robot's order",
            )
        )


def _check_misfit(data: Measurements, identification: Identification) -> None:
    """Refuse or doubt measurements that even a full geometric calibration does not explain."""
    spread = _spread(data.points)
    if identification.rms <= DOUBTFUL_MISFIT * spread:
        return
    text = sentence(
        "the measurements do not fit this robot, even with geometric errors",
        expected=f"a residual well below the points' spread of {spread:.3g} m",
        got=f"{identification.rms:.3g} m RMS",
        fix="check the tip link, the joint columns and their order, and that rows pair joints with their own points",
    )
    if identification.rms > GEOMETRIC_MISFIT * spread:
        raise MeasurementError(text)
    warnings.warn(text, DiffeoCalibWarning, stacklevel=3)


def _check_fit(robot: Chain, data: Measurements, registration: Identification) -> None:
    """Refuse units and pairings that cannot be right, before they are calibrated away."""
    if len(data) > 1 and not bool((data.q != data.q[0]).any()):
        what = f"all {len(data)} rows hold the same configuration: the robot does not move"
        raise MeasurementError(sentence(what, fix="measure poses in which every joint moves"))
    measured, nominal = _spread(data.points), _spread(registration.geometry.points(data.q))
    tips = _spread(robot(data.q)[:, None, :3, 3])
    if tips > 0 and not 1 / UNIT_RATIO < measured / tips < UNIT_RATIO:
        raise MeasurementError(
            sentence(
                "the measured points do not have the robot's size",
                expected=f"a spread of about {tips:.3g} m, the tip's over these configurations",
                got=f"{measured:.3g} m",
                fix="check the length unit (mm or m) and the angle unit (deg or rad)",
            )
        )
    if registration.rms > MISFIT * max(measured, nominal):
        raise MeasurementError(
            sentence(
                "the measurements do not fit this robot: no base frame and markers explain them",
                expected=f"a residual well below the points' spread of {measured:.3g} m",
                got=f"{registration.rms:.3g} m RMS",
                fix="check the angle unit, the order of the joints, and that rows pair joints with their own points",
            )
        )


def _spread(points: Tensor) -> float:
    """Root mean square distance of the markers from their centre, m."""
    centred = points - points.mean(dim=0, keepdim=True)
    return float(centred.square().sum(-1).mean().sqrt())
