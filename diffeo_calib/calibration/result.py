"""Result of a calibration: the model, the stages that led to it, the findings, and how much each part explains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.hypotheses import Length
from diffeo_calib.calibration.diagnostics.judged_rows import Outlier
from diffeo_calib.calibration.expected_errors import ExpectedError
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.placing.place import Placed
from diffeo_calib.calibration.placing.placement import Placement, Sessions
from diffeo_calib.calibration.placing.readings import ReadingDevices, SocketDevices
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.selection import Selection
from diffeo_calib.fitting.result import Fit
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import residuals
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.transmission import NamedGearLine, gear_lines
from diffeo_calib.regression.tails import Tails
from diffeo_calib.sensors.coordinates import Places, joined
from diffeo_calib.sensors.errors import Evaluation, Evaluations
from diffeo_calib.sensors.kinds import with_positions

STAGES = NOMINAL, GEOMETRIC, CALIBRATED = "nominal", "geometric", "calibrated"
"""The stages of a calibration: base and markers only, with an error of every joint, and the model."""


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


@dataclass(frozen=True, repr=False)
class CalibrationResult:
    """A calibration, stage by stage.

    Attributes:
        model: the calibrated kinematics.
        placed: the rows in the frame of the model, and their devices.
        selection: the scales of kernels, priors and noise, and how they were chosen.
        tails: how heavy the tails of the noise are, and the weight of every measurement.
        leave_one_out: error of every configuration as predicted from all others, in closed form; left_out: their sizes,
            kind by kind and in the unit of each.
        parts: how much each part of the model explains.
        gear_lines: periodic errors of gears, such as "joint_3: gear line 200.3 per rad = 2 x 100.15, 0.070 mrad".
        outliers: measurements far from their prediction.
        fit: the exact model's fit with its certificates.
        lengths: sizes of the robot, of its links and of devices against what they are said to be.
        partial: whether the model holds for some of the rows alone, since something changed during them.
        registration: base and markers only. identification: full geometry, the classical baseline.
        placement: devices in unknown places and what is known of them: measuring frames of sessions (the model's is
            that of the largest), sockets, and the devices of readings.
        expected: the error that the model expects over the joint ranges of its rows.
        stages: the kinematics of every stage by name, to compare them; status: how it ended, in one sentence.
    """

    model: CalibratedKinematics
    placed: Placed
    selection: Selection
    tails: Tails
    leave_one_out: LeaveOneOut
    parts: list[Part]
    outliers: list[Outlier]
    fit: Fit
    lengths: list[Length]
    partial: bool

    def __repr__(self) -> str:
        return f"CalibrationResult({self.model!r}: {self.status})"

    @property
    def registration(self) -> Identification:
        """Base and markers only."""
        return self.placed.registration

    @property
    def identification(self) -> Identification:
        """The geometric calibration."""
        return self.placed.identification

    @property
    def placement(self) -> Placement:
        """The devices and their places."""
        return self.placed.placement

    @property
    def sessions(self) -> Any:
        """Measuring frames, or markers, of the sessions, if the measurements name several; None otherwise."""
        return self.placement.one(Sessions)

    @property
    def sockets(self) -> SocketDevices | None:
        """Places of the sockets and how well they are predicted, if a ball rested in sockets."""
        return self.placement.one(SocketDevices)

    @property
    def readings(self) -> list[ReadingDevices]:
        """The devices of readings, a set for each kind."""
        return self.placed.readings

    @cached_property
    def expected(self) -> ExpectedError:
        """Errors that the model expects of itself over the joint ranges of the rows; larger with a doubtful length."""
        return ExpectedError.of(self.model)

    def aligned(self, data: Any) -> Any:
        """Rows of the same sessions in the frame of the model; those without positions, and of one session, stay."""
        return with_positions(data, self.placement.aligned)

    @property
    def stages(self) -> dict[str, Callable[[Tensor], Tensor]]:
        """Name of each stage -> its kinematics, (N, n) -> (N, P, 3) in m."""
        kinematics = self.registration.geometry.points, self.identification.geometry.points, self.model
        return dict(zip(STAGES, kinematics, strict=True))

    def places(self, stage: str = STAGES[-1]) -> Places:
        """Where the devices are as of a stage: frames of sessions, devices of readings."""
        now = [kind.devices for kind in self.readings]
        devices = (self.registration.devices, self.identification.devices, now)[STAGES.index(stage)]
        others = [kind.devices for kind in self.placement if not kind.devices.reads]
        others = [each for each in others if stage == CALIBRATED or not each.cameras]  # first images know no lens yet
        return Places(joined([*others, *devices]), self.placed.ball)

    def errors(self, data: Any) -> dict[str, dict[str, Evaluation]]:
        """Errors by the kind of the rows and by stage, of rows in the measuring frames of the sessions."""
        by_stage = {name: residuals(kinematics, self.places(name), data) for name, kinematics in self.stages.items()}
        kinds = next(iter(by_stage.values()))
        return {kind: {name: by_kind[kind] for name, by_kind in by_stage.items()} for kind in kinds}

    @property
    def left_out(self) -> Evaluations:
        """Sizes of leave-one-out errors by the kind of the rows: those of rows in sockets are spreads."""
        return self.placed.by_kind(self.leave_one_out.errors)

    @property
    def left_out_rms(self) -> float:
        """Root mean square of leave-one-out errors of measured positions, m; else see :attr:`Evaluations.rms`."""
        return self.left_out.rms

    @property
    def gear_lines(self) -> tuple[NamedGearLine, ...]:
        """Periodic errors of gears that the data show, the largest first; each has a `sentence`."""
        return gear_lines(self.model)

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C cut the work short; the model is then the best state so far."""
        return self.fit.solution.interrupted or self.selection.interrupted

    @property
    def status(self) -> str:
        """How the calibration ended, in one sentence."""
        if self.selection.interrupted and not self.fit.solution.interrupted:
            how = "interrupted in the search for scales, the best so far are kept"
            return f"{how}; fitted with them: {self.fit.status}"
        return f"{self.fit.status}; scales: {self.selection.status}"


MOST_CONFIGURATIONS = 8000  # configurations on which the parts of a model are measured


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
    errors, _ = nominal.split(theta)
    jacobian = nominal.jacobian(x, theta)
    joints, offsets = _joint_parts(model, x, jacobian)
    registered, refined = nominal.geometry.points(x), nominal.geometry.points(x, errors)
    explained = [Part("geometry", _rms((refined - registered).flatten(1) + jacobian @ offsets))]
    effects = nominal.sensitivities(x, theta) * theta
    if nominal.elasticity is not None:
        sag = effects[..., nominal.sag]
        explained += [Part(name, _rms(sag[..., columns].sum(-1))) for name, columns in nominal.elasticity.parts.items()]
    crooked = effects[..., nominal.parts["axes"]].split([6 * count for *_, count in nominal.own.axes], -1)
    for (axis, *_), moved in zip(nominal.own.axes, crooked, strict=False):
        explained.append(Part(f"the axis of {model.robot.moving_names[axis]}", _rms(moved.sum(-1))))
    joints += [Part(f"gear line {line.frequency:.1f} of {line.joint}", line.displacement) for line in gear_lines(model)]
    points = deformation.spec.nominal(x, theta).reshape(-1, deformation.spec.task_dim)
    bent = deformation.spec.task_kernel.field(points, deformation.task_controls, deformation.momenta.task)
    return [*explained, *joints, Part("task space", _rms(bent))]


def _joint_parts(model: CalibratedKinematics, x: Tensor, jacobian: Tensor) -> tuple[list[Part], Tensor]:
    """Transmission of every joint, then the coupled joint errors; and the transmissions' means (n,)."""
    deformation = model.map.deformation
    explained, coupled, means = [], torch.zeros_like(jacobian[..., 0]), torch.zeros_like(x[0])
    for term in deformation.spec.joint_kernel.terms:
        v = term.field(x, deformation.x, deformation.momenta.joint)
        if isinstance(term, RadialKernel) and term.output is not None:
            means = means + v.mean(0)
            varying = v - v.mean(0)
            angle = float(varying[:, term.output].square().mean().sqrt())
            moved = _rms((jacobian @ varying[:, :, None])[..., 0])
            explained.append(Part(f"transmission of {model.robot.joint_names[term.output]}", moved, angle))
        else:
            coupled = coupled + (jacobian @ v[:, :, None])[..., 0]
    return [*explained, Part("coupled joint errors", _rms(coupled))], means


def _rms(displacements: Tensor) -> float:
    """Root mean square length of displacements, coordinates in triples, m."""
    return float(displacements.reshape(-1, 3).square().sum(-1).mean().sqrt())
