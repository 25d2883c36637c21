"""`diffeo-calib predict`: marker positions, or poses, for a table of joint configurations."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import isfinite

import torch
from torch import Tensor

from diffeo_calib.cli.console import progress_bar, say
from diffeo_calib.cli.declarations import PredictOptions
from diffeo_calib.cli.models import as_fitted, check_payload_column, load_kinematics, provenance_lines
from diffeo_calib.cli.options import Rows
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables import joint_columns, joints_of, table_format, with_rows
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.device_readings import PredictedReadings
from diffeo_calib.kinematics.joint_ranges import refuse_other_angles, warn_outside_range
from diffeo_calib.measurements.csv.cells import number
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.files import Predictions, read_configurations, write_predictions
from diffeo_calib.measurements.csv.joints import PoseColumns
from diffeo_calib.measurements.table_format import BESIDE, TableFormat, options_of

ROWS_AT_ONCE = 2048
"""A multiple of the rows that predictions linearise together: blocks do not change their last digits."""
OWN_FRAME = (
    "no device measured positions: they are in the model's own frame, and 95 % regions hold true points only after one "
    "rigid motion of all of them; `evaluate --free both` with measured positions finds it"
)


def run(given: PredictOptions) -> None:
    """Read joint values, and write them with predictions and their standard deviations, block by block.

    A payload that is a number is the mass of all rows.
    """
    kinematics, output = load_kinematics(given.model), given.output
    say(*provenance_lines(kinematics))
    table, joints = _written_as_read(kinematics, given)
    robot, with_poses = kinematics.robot, kinematics.lever is not None
    if not with_poses and (table.convention or table.rotation_angle):
        what = "--convention and --rotation-angle say how orientations are written, but this model has none"
        raise InputError.of(what, fix="leave them out, or calibrate with measured poses")
    names = joint_columns(joints, robot)
    mass = number(given.payload or "", ".")  # what the model's fit named is a column
    if mass is not None and isfinite(mass):
        kinematics, table = kinematics.with_payload(mass), replace(table, payload=None)
    else:
        check_payload_column(kinematics, table.payload)
    written = names.written if isinstance(names, PoseColumns) else names
    prefixes, columns = kinematics.bodies.prefixes(kinematics), table.joints_only(written, robot.kinds)
    added = {f"{prefix}{axis}" for prefix in prefixes for axis in "xyz"}
    if added & {*Columns.of(columns).names}:  # commanded places have these names
        prefixes = tuple(f"predicted_{prefix}" for prefix in prefixes)
    readings = _Readings(table, kinematics.predict_readings(kinematics.configurations[:1]))
    values = read_configurations(given.csv, names, table, kinds=robot.kinds)
    q, masses = values["q"], values.get("payload")
    refuse_other_angles(kinematics, q)
    warn_outside_range(kinematics, q)

    def blocks() -> Iterator[Predictions]:
        for first in range(0, len(q), ROWS_AT_ONCE):
            progress("rows", first, len(q))
            own = slice(first, first + ROWS_AT_ONCE)
            model = kinematics if masses is None else kinematics.at_payloads(masses[own])
            mean, covariance = model.bodies.written(model, q[own])
            deviations = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
            yield q[own], mean, deviations, readings.cells(model, q[own])

    with progress_bar() as progress:
        how = {"kinds": robot.kinds, "prefixes": prefixes, "more": readings.names, "poses": with_poses}
        write_predictions(output, blocks(), table, joints=written, **how)
    record.add(rows=len(q), files={"table": output})
    what = "poses" if with_poses else "positions"
    say(f"{len(q)} predictions written to {output}: joints, {what} and standard deviations of a new measurement")
    if kinematics.own_frame:
        say(OWN_FRAME)
    say(*readings.sentences())
    if with_poses:
        say(f"`evaluate` and `fit` read these poses with {reading_options(table, prefixes)}")


def _written_as_read(
    model: CalibratedKinematics, given: PredictOptions
) -> tuple[TableFormat, str | PoseColumns | None]:
    """The format of the predictions, and the names of the joint columns, by default those of the fit."""
    units = given.units
    rows = Rows(convention=given.convention, rotation_angle=given.rotation_angle, payload=given.payload)
    read, stated = as_fitted(model, rows, units)
    if units.length is None or units.angle is None:
        rotation_angle = rows.rotation_angle or read.rotation_angle
        rows = Rows(convention=rows.convention or read.convention, rotation_angle=rotation_angle, payload=read.payload)
    return with_rows(table_format(stated), rows), joints_of(stated)


def reading_options(table: TableFormat, prefixes: Sequence[str] = ("",)) -> str:
    """The options with which `evaluate` and `fit` read the poses that `predict` writes in this format."""
    written, units = table.for_writing(rotation_std=False, prefixes=prefixes), table.joints_only(())
    position = [[prefix + axis for axis in "xyz"] for prefix in prefixes]
    turned = {name: getattr(written, name) for name in ("rotation", "convention", "rotation_angle")}
    return shlex.join(options_of(replace(units, position=position, **turned, **dict.fromkeys(BESIDE))))


@dataclass(frozen=True)
class _Readings:
    """Columns of what ``devices`` will read, and of standard deviations; lengths in the unit of the table."""

    table: TableFormat
    devices: Sequence[PredictedReadings]

    def _unit(self, unit: str) -> tuple[str, float]:
        """The unit that is written, and how many of it are one of the device's."""
        metres = {"mm": 1e-3, "m": 1.0}.get(unit)
        return (unit, 1.0) if metres is None else (self.table.length, metres * self.table.per_metre)

    @property
    def names(self) -> list[str]:
        """KIND_DEVICE and std_KIND_DEVICE, of several numbers with _1, _2."""
        counts = [(own, range(1, 1 + own.mean.shape[1])) for own in self.devices]
        ends = [(f"{own.kind}_{own.device}", [f"_{k}" if len(ks) > 1 else "" for k in ks]) for own, ks in counts]
        return [f"{std}{name}{end}" for name, each in ends for std in ("", "std_") for end in each]

    def cells(self, model: CalibratedKinematics, q: Tensor) -> Tensor:
        """(B, k) means and standard deviations of every device."""
        parts = [q[:, :0]]
        for own in model.predict_readings(q) if self.devices else ():
            parts += [self._unit(own.unit)[1] * values for values in (own.mean, own.deviations)]
        return torch.cat(parts, 1)

    def sentences(self) -> Iterator[str]:
        """Meaning of the columns, and the width of 95 % regions."""
        for own in self.devices:
            numbers = own.mean.shape[1]
            widths = f"within {chi2_above(0.05, numbers) ** 0.5:.2f} standard deviations"
            unit = self._unit(own.unit)[0]
            yield f"{own.kind}_{own.device}: what this device will read, in {unit}; 95 % of new readings are {widths}"
