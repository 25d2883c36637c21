"""`diffeo-calib correct`: a program whose commands bring the calibrated robot to the intended poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import degrees, radians
from pathlib import Path

import torch
from rich.table import Table
from torch import Tensor

from diffeo_calib.cli.console import out, plain, say
from diffeo_calib.cli.models import load_laden, tool_in_tip
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables import ProgramTable, joint_columns
from diffeo_calib.common.checks import check_number
from diffeo_calib.common.errors import InputError, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.compensation.compensate import Compensation, compensate
from diffeo_calib.kinematics.evaluation import warn_outside_range
from diffeo_calib.measurements.csv_columns import Columns
from diffeo_calib.measurements.csv_program import Column, Program
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.tree import Tree

AXES_OF_A_POSE = 6
MOST_PREDICTED = 100
"""Most rows whose deviations are predicted."""
MOST_MISSED = 10
"""Most lines about rows that are not reached."""


@dataclass(frozen=True)
class Options:
    """What the command line says beside the table.

    Args:
        tool: numbers of the tool centre point; None for the model's own.
        tool_from: "tip" or "measured", the frame of these numbers.
        frame: "base" or "measuring". limit: largest correction, deg; None for the default.
        rate: largest change of a correction from row to row, deg; None if the rows are no path.
        payload: mass that the robot carries; None for a model without payloads.
    """

    tool: str | None
    tool_from: str
    frame: str
    limit: float | None
    rate: float | None
    payload: float | None = None


def run(model: Path, source: ProgramTable, options: Options, output: Path) -> None:
    """Read a program, correct it, write it and print a summary.

    Raises:
        InputError: options that contradict each other, columns that are missing or taken.
    """
    kinematics, table = load_laden(model, options.payload), source.written()
    robot = kinematics.robot
    _check(options, source)
    tool = tool_in_tip(kinematics, options.tool, options.tool_from, table)
    program = Program.read(source.csv, table)
    start, targets = source.commands(robot), source.targets(robot)
    oriented = targets is None or targets.ndim == 3
    program.check_free([*_pose_names(table), *_miss_names(table, oriented=oriented)])
    warn_outside_range(kinematics, start)
    goals = robot(start) @ tool if targets is None else targets
    bound = None if options.limit is None else radians(options.limit)
    rate = None if options.rate is None else radians(options.rate)
    found = compensate(
        kinematics, goals, start, tool=tool, frame=options.frame, bound=bound, path=rate is not None, rate=rate
    )
    columns = Columns.of(table.joints_only(), joint_columns(source.joints, robot), robot.kinds, [])
    program.write(output, found.q, columns, _added(robot, found, tool, table), table)
    record.add(rows=len(found), statuses=found.counts, files={"program": output})
    _summarise(kinematics, found, tool, program.lines)
    _say_how_well_known(kinematics, found, tool, options.frame)
    say(f"{len(found)} rows written to {output}: corrected joints, pose to command, status and miss")


def _check(options: Options, source: ProgramTable) -> None:
    """Refuse options that say nothing."""
    if options.limit is not None:
        check_number(options.limit, "--limit", above=0.0)
    if options.rate is not None:
        check_number(options.rate, "--rate", above=0.0)
    if options.frame == "measuring" and source.position is None:
        fix = "leave it out, or name the columns of the targets (--position)"
        raise InputError.of("--frame measuring: the nominal poses of commands are in the robot's base", fix=fix)


def _pose_names(table: TableFormat) -> list[str]:
    return [f"command_{name}" for name in ("x", "y", "z", *(table.rotation or ()))]


def _miss_names(table: TableFormat, *, oriented: bool) -> list[str]:
    return ["status", f"miss_{table.length}", *[f"angle_miss_{table.angle}"] * oriented]


def _added(robot: Tree, found: Compensation, tool: Tensor, table: TableFormat) -> dict[str, Column]:
    """The columns beside those of the program; poses and misses are NaN where there is no command."""
    allowed = found.q.isfinite().all(1)
    numbers = torch.full((len(found), len(_pose_names(table))), torch.nan, dtype=torch.float64, device=found.q.device)
    if bool(allowed.any()):
        poses = robot(found.q[allowed]) @ tool
        unit = table.rotation_angle or "rad"
        turned = rotation_numbers(poses[:, :3, :3], table.convention or "rotvec", angle=unit)
        numbers[allowed] = torch.cat([poses[:, :3, 3] * table.per_metre, turned], dim=1)
    added: dict[str, Column] = dict(zip(_pose_names(table), numbers.mT.tolist(), strict=True))
    names = _miss_names(table, oriented=found.angle_miss is not None)
    added[names[0]] = [str(status) for status in found.status]
    added[names[1]] = (found.miss * table.per_metre).tolist()
    if found.angle_miss is not None:
        angle = found.angle_miss.rad2deg() if table.angle == "deg" else found.angle_miss
        added[names[2]] = angle.tolist()
    return added


def _summarise(kinematics: CalibratedKinematics, found: Compensation, tool: Tensor, lines: list[int]) -> None:
    """Print sizes of corrections, counts of statuses, and the first rows that are not reached."""
    robot, allowed = kinematics.robot, found.q.isfinite().all(1)
    if bool(allowed.any()):
        table = Table(title="Corrections", title_justify="left")
        for column in ("", "median", "max"):
            table.add_column(column, justify="right" if column else "left")
        moved = (robot(found.q[allowed]) @ tool)[:, :3, 3] - (robot(found.start[allowed]) @ tool)[:, :3, 3]
        _add_sizes(table, "tool, mm", 1e3 * moved.norm(dim=1))
        change = found.correction[allowed].abs()
        for joint, name in enumerate(robot.joint_names):
            turns = robot.periodic[joint]
            sizes = change[:, joint].rad2deg() if turns else 1e3 * change[:, joint]
            _add_sizes(table, plain(f"{name}, {'deg' if turns else 'mm'}"), sizes)
        out.print(table)
    say(f"{len(found)} rows: " + ", ".join(f"{count} {name}" for name, count in found.counts.items()))
    for line in _missed_lines(found, lines):
        say(line)
    few_joints = kinematics.robot.n < AXES_OF_A_POSE and found.angle_miss is not None
    if few_joints and 2 * int(found.reached.sum()) < len(found):
        fix = "name target positions instead (--position)"
        warn_user(sentence("a robot with fewer than six joints cannot hold every orientation", fix=fix))
    elif 2 * found.counts.get("unreachable", 0) > len(found):
        what = "most targets are farther from their commands than the largest correction allows"
        warn_user(sentence(what, fix="check the frame, the unit and the columns of the targets, and --tool"))


def _say_how_well_known(model: CalibratedKinematics, found: Compensation, tool: Tensor, frame: str) -> None:
    """Print the deviations with which the model knows the tool at the commands: a miss of zero is one on the model."""
    q = found.q[found.q.isfinite().all(1)]
    if not len(q):
        return
    some = q[
        torch.linspace(0, len(q) - 1, min(len(q), MOST_PREDICTED), dtype=torch.float64, device=q.device).round().long()
    ]
    _, covariance = model.predict_tool_poses(some, tool, frame)
    variances = covariance.diagonal(dim1=1, dim2=2).mean(0)
    shift, turn = (float(part.sum().sqrt()) for part in (variances[:3], variances[3:]))
    where = "robot's base" if frame == "base" else "measuring frame"
    known = f"{1e3 * shift:.3f} mm and {degrees(turn):.4f} deg (standard deviation)"
    say(f"statuses and misses are those of the model, which knows the tool in the {where} to {known}")


def _add_sizes(table: Table, label: str, sizes: Tensor) -> None:
    table.add_row(label, f"{float(sizes.median()):.4f}", f"{float(sizes.max()):.4f}")


def _missed_lines(found: Compensation, lines: list[int]) -> Iterator[str]:
    """Sentences about the first rows that are not reached."""
    missed = (~found.reached).nonzero().flatten().tolist()
    for row in missed[:MOST_MISSED]:
        if not bool(found.q[row].isfinite().all()):
            yield f"  line {lines[row]}: {found.status[row]}, no command is allowed: it starts beyond a joint's limit"
            continue
        angle = "" if found.angle_miss is None else f" and {float(found.angle_miss[row].rad2deg()):.4f} deg"
        yield f"  line {lines[row]}: {_reason(found, row)}, misses by {1e3 * float(found.miss[row]):.4f} mm{angle}"
    if len(missed) > MOST_MISSED:
        yield f"  and {len(missed) - MOST_MISSED} more; see the column `status`"


def _reason(found: Compensation, row: int) -> str:
    """A status, and what "unreachable" means: the largest correction is part of it."""
    status = found.status[row]
    return "unreachable with corrections within --limit" if status == "unreachable" else str(status)
