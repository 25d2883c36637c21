"""Tables for controllers: joint offsets, corrections against joint value, the error field of a machine with places.

Signs. The robot's joint is at ``reading + e(reading)`` when its encoder reads ``reading``, e the transmission error. To
bring the joint itself to q, command c with c + e(c) = q: the correction c - q is what a controller adds to q. A joint
offset is a constant e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, prod, radians
from os import PathLike

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_number
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.common.files import write_whole
from diffeo_calib.interop.rigid import JointOffsets, best_joint_offsets
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.compensation.compensate import compensate
from diffeo_calib.measurements.csv.cells import csv_text
from diffeo_calib.measurements.csv.columns import PER_SI
from diffeo_calib.measurements.table_format import ANGLE_UNITS, UNITS_PER_METRE
from diffeo_calib.robots.cartesian import SLIDES, is_cartesian
from diffeo_calib.robots.se3 import roll_pitch_yaw_angles
from diffeo_calib.robots.tree import Tree

TURN_STEP, SLIDE_STEP = radians(0.5), 5e-4  # distance between the rows of a table, rad and m
MOST_ROWS = 100_000
FIXED_POINT_STEPS = 20  # of c = q - e(c): every step makes the error smaller by the slope of e, a thousandth or so


def origin_numbers(transform: Tensor) -> tuple[list[float], list[float]]:
    """A rigid transform (4, 4) as x, y, z [m] and roll, pitch, yaw [rad], R = Rz(yaw) Ry(pitch) Rx(roll)."""
    xyz, rpy = transform[:3, 3].tolist(), roll_pitch_yaw_angles(transform[:3, :3])
    return [value + 0.0 for value in xyz], [value + 0.0 for value in rpy]  # no -0.0


def check_units(length: str, angle: str) -> None:
    """Raise InputError for a unit that tables do not have."""
    for name, value, units in (("length", length, UNITS_PER_METRE), ("angle", angle, ANGLE_UNITS)):
        if value not in units:
            raise InputError.of(f"`{name}`", expected=" or ".join(map(repr, units)), got=as_written(value))


def in_unit(values: Sequence[float], unit: str) -> list[float]:
    """Lengths in m or angles in rad -> in a unit."""
    return [value * PER_SI[unit] for value in values]


@dataclass(frozen=True, eq=False)
class CorrectionTable:
    """Transmission errors of one joint over the range in which it was measured."""

    joint: str  # its name
    turns: bool  # whether it is revolute
    values: Tensor  # (M,) joint values q, evenly spaced from the smallest measured value to the largest [rad or m]
    errors: Tensor  # (M,) e(q): what the joint moves beyond its reading [rad or m]
    corrections: Tensor  # (M,) what a controller adds to q so that the joint comes to q [rad or m]
    between: float  # largest error of linear interpolation between the rows [rad or m]


def correction_tables(
    model: CalibratedKinematics, *, turn_step: float = TURN_STEP, slide_step: float = SLIDE_STEP
) -> list[CorrectionTable]:
    """Transmission error of every active joint against its value; only where it was measured.

    Transmission errors are those of :meth:`CalibratedKinematics.transmission`. Their constant part and their first
    harmonic can hardly be told from geometric errors and gravity sag. Use the tables with
    ``rigid_kinematics(model, transmission=True)``, fitted to them: with nominal kinematics they improve little.
    Gravity sag and everything that depends on several joints is not in the tables.

    Args:
        model: calibrated kinematics.
        turn_step: distance between rows of revolute joints [rad]. slide_step: of prismatic joints [m].

    Raises InputError: a step that is not positive, or tables of more than 100,000 rows.
    """
    for name, step in (("`turn_step`", turn_step), ("`slide_step`", slide_step)):
        check_number(step, name, above=0.0)
    steps = [(turn_step if turns else slide_step, turns) for turns in model.robot.periodic]
    return [_table(model, index, *step) for index, step in enumerate(steps)]


def write_correction_tables(
    model: CalibratedKinematics, path: str | PathLike[str], *, length: str = "m", angle: str = "rad"
) -> None:
    """Write the tables of all joints as one CSV file, one row per joint value; units have their own column.

    Args:
        model: see :func:`correction_tables`. path: the file. length: "m" or "mm". angle: "rad" or "deg".

    Raises InputError: another unit, or a file that cannot be written.
    """
    check_units(length, angle)
    write_whole(path, tables_text(correction_tables(model), length, angle).encode())


def write_joint_offsets(
    model: CalibratedKinematics, path: str | PathLike[str], *, length: str = "m", angle: str = "rad"
) -> None:
    """Write the best joint offsets as CSV: to be added to the joints' readings before nominal kinematics.

    Args:
        model: see :func:`best_joint_offsets`. path: the file. length: "m" or "mm". angle: "rad" or "deg".

    Raises InputError: another unit, or a file that cannot be written.
    """
    check_units(length, angle)
    write_whole(path, offsets_text(best_joint_offsets(model), model.robot, length, angle).encode())


def tables_text(tables: Sequence[CorrectionTable], length: str, angle: str) -> str:
    """Tables of all joints as CSV; see :func:`write_correction_tables`."""
    rows: list[list[object]] = []
    for table in tables:
        unit = angle if table.turns else length
        columns = (in_unit(column.tolist(), unit) for column in (table.values, table.errors, table.corrections))
        rows += [[table.joint, unit, *row] for row in zip(*columns, strict=True)]
    return csv_text([["joint", "unit", "value", "transmission_error", "correction_to_add"], *rows])


def offsets_text(best: JointOffsets, robot: Tree, length: str, angle: str) -> str:
    """Joint offsets as CSV; see :func:`write_joint_offsets`."""
    units = [angle if turns else length for turns in robot.periodic]
    each = zip(robot.joint_names, units, best.offsets.tolist(), strict=True)
    rows = [[name, unit, *in_unit([offset], unit)] for name, unit, offset in each]
    return csv_text([["joint", "unit", "offset_to_add_to_reading"], *rows])


def _table(model: CalibratedKinematics, index: int, step: float, turns: bool) -> CorrectionTable:
    joint, measured = model.robot.joint_names[index], model.configurations[:, index]
    low, high = (float(end) for end in measured.aminmax())
    count = max(ceil((high - low) / step), 1)
    if count > MOST_ROWS:
        what = f"the table of '{joint}' has {count} rows"
        raise InputError.of(what, expected=f"at most {MOST_ROWS}", fix="take a larger step")
    q = torch.linspace(low, high, 2 * count + 1, dtype=torch.float64, device=measured.device)  # and points between rows
    correction = torch.zeros_like(q)
    for _ in range(FIXED_POINT_STEPS):
        correction = -model.transmission(joint, q + correction)
    rows, middle = correction[::2], correction[1::2]
    between = float(((rows[1:] + rows[:-1]) / 2 - middle).abs().max())
    values, errors, corrections = (t.detach().cpu() for t in (q[::2], model.transmission(joint, q[::2]), rows))
    return CorrectionTable(joint, turns, values, errors, corrections, between)


MOST_POINTS = 100_000
DIGITS = 7


def field_text(model: CalibratedKinematics, grid: str, length: str) -> str:
    """A table of places within those of the fit, what to add to commands there, and its standard deviations, as CSV.

    Orientations are in the middle of those of the fit. Deviations are those of the first marker, or point of a pose,
    along the axes of the machine.

    Args:
        model: of a machine with commanded places or poses, see :func:`diffeo_calib.cartesian`.
        grid: numbers of points along each axis, such as "5x5x3". length: unit in the file.

    Raises InputError: a model of joint values, another number of axes, or more than 100,000 points.
    """
    robot, counts = model.robot, [int(word) if word.isdigit() else 0 for word in grid.lower().split("x")]
    axes = min(robot.n, len(SLIDES))
    if not is_cartesian(robot):
        fix = "calibrate with --robot-pose, or correct a program with `correct`"
        raise InputError.of("an error field", expected="a machine with commanded places", got=robot.name, fix=fix)
    if len(counts) != axes or min(counts) < 2 or prod(counts) > MOST_POINTS:
        expected = f"{axes} numbers of 2 or more, such as {'x'.join('5' * axes)}, at most {MOST_POINTS} points"
        raise InputError.of(f"--grid {grid}", expected=expected)
    fitted = model.configurations
    ends = zip(fitted.amin(0)[:axes].tolist(), fitted.amax(0)[:axes].tolist(), counts, strict=True)
    lines = [torch.linspace(*each, dtype=fitted.dtype, device=fitted.device) for each in ends]
    places = torch.cartesian_prod(*lines).view(-1, axes)
    q = torch.cat([places, places.new_zeros(len(places), robot.n - axes)], 1)
    targets = robot(q) @ model.tool
    compensation = compensate(model, targets if robot.n > axes else targets[:, :3, 3], q)
    base = model.geometry.base[:3, :3]
    covariance = base.mT @ model.predict(q, noise=False)[1][:, 0] @ base
    deviations = covariance.diagonal(dim1=1, dim2=2)[:, :axes].sqrt()
    cells = UNITS_PER_METRE[length] * torch.cat([places, compensation.correction[:, :axes], deviations], 1)
    header = [f"{word}{axis} [{length}]" for word in ("", "add_", "std_") for axis in "xyz"[:axes]]
    return csv_text([header, *cells.round(decimals=DIGITS).tolist()])
