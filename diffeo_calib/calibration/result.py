"""Result of a calibration: the model, the stages that led to it, and the findings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from torch import Tensor

from diffeo_calib.calibration.diagnostics.judge import Length
from diffeo_calib.calibration.diagnostics.outliers import Outlier
from diffeo_calib.calibration.expected_errors import ExpectedError
from diffeo_calib.calibration.findings import Part
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.placing.place import Placed
from diffeo_calib.calibration.placing.placement import Placement
from diffeo_calib.calibration.placing.readings import ReadingDevices
from diffeo_calib.calibration.placing.sessions import Sessions
from diffeo_calib.calibration.placing.sockets import SocketDevices
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.selection import Selection
from diffeo_calib.common.data_frames import table_html
from diffeo_calib.fitting.result import Fit
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import residuals
from diffeo_calib.kinematics.transmission import NamedGearLine, gear_lines
from diffeo_calib.process.tails import Tails
from diffeo_calib.sensors.errors import Evaluation, Evaluations
from diffeo_calib.sensors.places import Places, joined
from diffeo_calib.sensors.tables import with_positions

STAGES = NOMINAL, GEOMETRIC, CALIBRATED = "nominal", "geometric", "calibrated"
"""The stages of a calibration: base and markers only, with an error of every joint, and the model."""


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

    def _repr_html_(self) -> str:
        """The model and what it explains, for notebooks."""
        rows = [[part.name, f"{1e3 * part.displacement:.4f}"] for part in self.parts]
        found = f"{len({one.row for one in self.outliers})} rows look wrong" if self.outliers else "no row looks wrong"
        parts = table_html(f"{self.status}; {found}", ("part", "displacement [mm]"), rows)
        return self.model._repr_html_() + parts

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
        own = self.registration.geometry.points, self.identification.geometry.points, self.model
        return dict(zip(STAGES, own, strict=True))

    def places(self, stage: str = STAGES[-1]) -> Places:
        """Where the devices are as of a stage: frames of sessions, devices of readings."""
        now = [own.devices for own in self.readings]
        devices = (self.registration.devices, self.identification.devices, now)[STAGES.index(stage)]
        others = [own.devices for own in self.placement if not own.devices.reads]
        return Places(joined([*others, *devices]), self.placed.ball)

    def errors(self, data: Any) -> dict[str, dict[str, Evaluation]]:
        """Errors by the kind of the rows and by stage, of rows in the measuring frames of the sessions."""
        found = {name: residuals(kinematics, self.places(name), data) for name, kinematics in self.stages.items()}
        kinds = next(iter(found.values()))
        return {kind: {name: own[kind] for name, own in found.items()} for kind in kinds}

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
