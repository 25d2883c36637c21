"""`diffeo-calib correct`: a program whose commands bring the calibrated robot to the intended poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import degrees, isnan, radians

import torch
from torch import Tensor

from diffeo_calib.cli.console import out, plain, progress_bar, say, text_table
from diffeo_calib.cli.models import as_fitted, load_laden, tool_in_tip
from diffeo_calib.cli.options import CorrectOptions
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables import ProgramTable, joint_columns, joints_of, table_format, written_columns
from diffeo_calib.common.checks import check_number
from diffeo_calib.common.errors import InputError, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.compensation.compensate import Compensation, compensate
from diffeo_calib.kinematics.joint_ranges import refuse_other_angles, warn_outside_range
from diffeo_calib.kinematics.tool import checked_tip, covariance_without_placement, tool_transform
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.joints import PoseColumns
from diffeo_calib.measurements.csv.writing import Column, Program
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.measurements.table_format import TableFormat, flat_names
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.tree import Tree

AXES_OF_A_POSE = 6
ROWS_AT_ONCE = 100
"""Rows whose deviations are predicted together."""
REASONS = {
    "unreachable": "unreachable with corrections within --limit",
    "singular": "singular: near a singularity it needs a correction larger than --limit",
}
"""Statuses in words: the largest correction is part of them."""
MOST_MISSED = 10
"""Most lines about rows that are not reached."""


@dataclass(frozen=True, eq=False)
class ToolOnTip:
    """A tool (4, 4) [m] on a tip; ``place`` is that of the tip among the robot's where several tools have targets."""

    tip: str
    tool: Tensor
    place: int | None = None

    def nominal(self, robot: Tree, q: Tensor) -> Tensor:
        """Poses (N, 4, 4) of the tool where the robot has no errors, m."""
        poses = robot(q)
        return (poses if poses.ndim == 3 else poses[:, robot.tips.index(self.tip)]) @ self.tool

    def known(self, model: CalibratedKinematics, q: Tensor, frame: str) -> tuple[Tensor, Tensor]:
        """Standard deviations (N, 2) of its poses, m and rad: in the frame, and apart from where base and tool sit."""
        whole, apart = [], []
        for rows in q.split(ROWS_AT_ONCE):
            whole.append(_deviations(model.predict_tool_poses(rows, self.tool, frame, self.tip)[1]))
            apart.append(_deviations(covariance_without_placement(model, rows, self.tool, self.tip)))
        return torch.cat(whole), torch.cat(apart)

    def own(self, values: Tensor) -> Tensor:
        """Its own part of a result."""
        return values if self.place is None else values[:, self.place]

    def name(self, before: str, after: str) -> str:
        """Name of a column: with that of the tip where there are several."""
        return f"{before}_{after}" if self.place is None else f"{before}_{self.tip}_{after}"

    @property
    def label(self) -> str:
        """Name of the tool in messages."""
        return "tool" if self.place is None else f"tool on {self.tip}"


def run(options: CorrectOptions) -> None:
    """Read a program, correct it, write it and print a summary; units that are not typed are those of the fit."""
    _check(options)
    kinematics = load_laden(options.model, options.payload_mass)
    stated = as_fitted(kinematics, None, options.units)[1]
    program, output = options.program, options.output
    source = ProgramTable(program, joints_of(stated), table_format(stated), options.targets)
    table = source.written()
    if len(options.tip or ()) == 1:
        kinematics = kinematics.with_tool(kinematics.tool, *options.tip or ())
    turned = {"convention": options.targets.convention, "rotation_angle": options.targets.rotation_angle}
    robot, tools = kinematics.robot, _tools(kinematics, options, replace(source.table, **turned))
    names = joint_columns(source.joints, robot)
    columns = Columns.of(table.joints_only(names, robot.kinds))
    sheet = Program.read(program, table, columns.names)
    if isinstance(names, PoseColumns) and names.is_program:
        columns = Columns.of(table.joints_only(written_columns(names), robot.kinds))
        sheet = sheet.without(names.columns)  # they would be those of the program before
        sheet.check_free(columns.names)
    start, targets = source.commands(robot), source.targets(robot, len(tools))
    oriented = targets is None or targets.ndim == 4
    sheet.check_free([name for tool in tools for name in _pose_names(tool, table)])
    sheet.check_free(["status", *(name for tool in tools for name in _miss_names(tool, table, oriented=oriented))])
    sheet.check_free([tool.name("std", table.length) for tool in tools])
    refuse_other_angles(kinematics, start)
    warn_outside_range(kinematics, start)
    if targets is None:
        targets = torch.stack([tool.nominal(robot, start) for tool in tools], dim=1)
        if is_cartesian(robot) and robot.n < AXES_OF_A_POSE:  # commanded places
            targets = targets[..., :3, 3]
    bound = None if options.limit is None else radians(options.limit)
    rate = None if options.rate is None else radians(options.rate)
    how = {"frame": options.frame, "bound": bound, "path": rate is not None, "rate": rate}
    with progress_bar() as progress:
        progress("commands", 0, 1)
        found = compensate(kinematics, _goals(robot, tools, targets), start, tool=_places(robot, tools), **how)
    allowed = found.q.isfinite().all(1)
    known = [tool.known(kinematics, found.q[allowed], options.frame) for tool in tools if bool(allowed.any())]
    sheet.write(output, columns.from_si({"q": found.q}) | _added(kinematics, found, tools, known, table), table)
    misses = {tool.tip: {"miss_m": tool.own(found.miss), "angle_miss_deg": _degrees(found, tool)} for tool in tools}
    record.add(rows=len(found), statuses=found.counts, misses=misses, files={"program": output})
    _summarise(kinematics, found, tools, sheet.lines)
    where = "robot's base" if options.frame == "base" else "measuring frame"
    for tool, each in zip(tools, known, strict=False):
        say(_how_well_known(tool, *each, where))
    frames = ", ".join(f"of the tool on {tool.tip}, in the frame of {robot.base}" for tool in tools)
    corrected = f"{len(found)} rows written to {output}: corrected {', '.join(columns.names)}"
    say(f"{corrected}, the pose to command ({frames}), status, miss and standard deviation")


def _check(options: CorrectOptions) -> None:
    """Refuse options without effect."""
    if options.limit is not None:
        check_number(options.limit, "--limit", above=0.0)
    if options.rate is not None:
        check_number(options.rate, "--rate", above=0.0)
    if options.frame == "measuring" and not options.targets.position:
        fix = "leave it out, or name the columns of the targets (--position)"
        raise InputError.of("--frame measuring: the nominal poses of commands are in the robot's base", fix=fix)


def _tools(model: CalibratedKinematics, named: CorrectOptions, table: TableFormat) -> list[ToolOnTip]:
    """The tools that have targets."""
    robot, tips = model.robot, named.tip or []
    if named.tool and len(named.tool) != max(len(tips), 1):
        expected, fix = f"{max(len(tips), 1)} of them", "give one tool for every --tip"
        raise InputError.of("--tool", expected=expected, got=len(named.tool), fix=fix)
    numbers = named.tool or [None] * max(len(tips), 1)
    if len(tips) < 2:
        tip = checked_tip(robot, model.tool_tip)
        return [ToolOnTip(tip, tool_in_tip(model, numbers[0], named.tool_from, table))]
    again = [tip for k, tip in enumerate(tips) if tip in tips[:k]]
    if again:
        raise InputError.of(f"--tip {again[0]} is named twice", fix="name every tip once")
    found = []
    for tip, text in zip(tips, numbers, strict=True):
        own = model.tool if checked_tip(robot, tip) == model.tool_tip else None
        tool = tool_in_tip(model.with_tool(own, tip), text, named.tool_from, table)
        found.append(ToolOnTip(tip, tool, robot.tips.index(tip)))
    return found


def _goals(robot: Tree, tools: list[ToolOnTip], targets: Tensor) -> Tensor:
    """Targets (N, T, ...) of the tools for :func:`compensate`, NaN for the robot's other tips."""
    if tools[0].place is None:
        return targets[:, 0]
    goals = targets.new_full((len(targets), len(robot.tips), *targets.shape[2:]), torch.nan)
    goals[:, [tool.place for tool in tools]] = targets
    return goals


def _places(robot: Tree, tools: list[ToolOnTip]) -> Tensor:
    """The tools (4, 4), or (T, 4, 4) of all tips."""
    by_tip = {tool.tip: tool.tool for tool in tools}
    only = tools[0].place is None
    return tools[0].tool if only else torch.stack([by_tip.get(tip, tool_transform(None)) for tip in robot.tips])


def _pose_names(tool: ToolOnTip, table: TableFormat) -> list[str]:
    return [tool.name("command", name) for name in ("x", "y", "z", *flat_names(table.rotation))]


def _miss_names(tool: ToolOnTip, table: TableFormat, *, oriented: bool) -> list[str]:
    return [tool.name("miss", table.length), *[tool.name("angle_miss", table.angle)] * oriented]


def _added(
    model: CalibratedKinematics,
    found: Compensation,
    tools: list[ToolOnTip],
    known: list[tuple[Tensor, Tensor]],
    table: TableFormat,
) -> dict[str, Column]:
    """The columns beside those of the program; poses and misses are NaN where there is no command or no target."""
    added: dict[str, Column] = {}
    allowed = found.q.isfinite().all(1)
    for tool in tools:
        names = _pose_names(tool, table)
        numbers = torch.full((len(found), len(names)), torch.nan, dtype=torch.float64, device=found.q.device)
        if bool(allowed.any()):
            poses = tool.nominal(model.robot, found.q[allowed])
            unit = table.rotation_angle or "rad"
            turned = rotation_numbers(poses[:, :3, :3], table.convention or "rotvec", angle=unit)
            numbers[allowed] = torch.cat([poses[:, :3, 3] * table.per_metre, turned], dim=1)
        added |= dict(zip(names, numbers.mT.tolist(), strict=True))
    added["status"] = [str(status) for status in found.status]
    for tool in tools:
        names = _miss_names(tool, table, oriented=found.angle_miss is not None)
        added[names[0]] = (tool.own(found.miss) * table.per_metre).tolist()
        if found.angle_miss is not None:
            angle = tool.own(found.angle_miss)
            added[names[1]] = (angle.rad2deg() if table.angle == "deg" else angle).tolist()
    for tool, (whole, _) in zip(tools, known, strict=False):
        deviations = torch.full((len(found),), torch.nan, dtype=torch.float64, device=found.q.device)
        deviations[allowed] = whole[:, 0] * table.per_metre
        added[tool.name("std", table.length)] = deviations.tolist()
    return added


def _degrees(found: Compensation, tool: ToolOnTip) -> Tensor | None:
    """Angles (N,) of the tool from its targets, NaN where it has none; None for targets without orientation."""
    return None if found.angle_miss is None else tool.own(found.angle_miss).rad2deg()


def _summarise(kinematics: CalibratedKinematics, found: Compensation, tools: list[ToolOnTip], lines: list[int]) -> None:
    """Print sizes of corrections, counts of statuses, and the first rows that are not reached."""
    robot, allowed = kinematics.robot, found.q.isfinite().all(1)
    if bool(allowed.any()):
        sizes, change = dict[str, Tensor](), found.correction[allowed].abs()
        for tool in tools:
            after, before = (tool.nominal(robot, q[allowed])[:, :3, 3] for q in (found.q, found.start))
            sizes[f"{tool.label}, mm"] = 1e3 * (after - before).norm(dim=1)
        for joint, name in enumerate(robot.joint_names):
            unit, own = ("deg", change[:, joint].rad2deg()) if robot.periodic[joint] else ("mm", 1e3 * change[:, joint])
            sizes[f"{name}, {unit}"] = own
        rows = [[plain(what), f"{float(own.median()):.4f}", f"{float(own.max()):.4f}"] for what, own in sizes.items()]
        out.print(text_table("Corrections", ["", "median", "max"], rows))
    say(f"{len(found)} rows: " + ", ".join(f"{count} {name}" for name, count in found.counts.items()))
    say(*_missed_lines(found, tools, lines))
    few_joints = robot.n < AXES_OF_A_POSE * len(tools) and found.angle_miss is not None
    if few_joints and 2 * int(found.reached.sum()) < len(found):
        fix = "name target positions instead (--position)"
        of_tools = "" if len(tools) == 1 else f" of {len(tools)} tools"
        warn_user(sentence(f"a robot with {robot.n} joints cannot hold every orientation{of_tools}", fix=fix))
    elif 2 * found.counts.get("unreachable", 0) > len(found):
        what = "most targets are farther from their commands than the largest correction allows"
        warn_user(sentence(what, fix="check the frame, the unit and the columns of the targets, and --tool"))


def _how_well_known(tool: ToolOnTip, whole: Tensor, apart: Tensor, where: str) -> str:
    """How well the model knows a tool, by deviations (N, 2) as of :meth:`ToolOnTip.known`: misses are the model's."""
    said = (
        f"statuses and misses are those of the model, which knows the {tool.label} in the {where} to "
        f"{_sizes(whole)[0]}, and its orientation to {_sizes(whole)[1]} (standard deviations)"
    )
    if float(apart.square().sum(0)[0]) >= float(whole.square().sum(0)[0]):  # as far from the rows of the fit
        return said
    return (
        f"{said}; apart from where the base stands and how the tool sits on its flange, which are the same for all "
        f"commands and can be taught anew, to {_sizes(apart)[0]} and {_sizes(apart)[1]}"
    )


def _deviations(covariance: Tensor) -> Tensor:
    """Standard deviations (M, 2) of positions and orientations, m and rad, of covariances (M, 6, 6)."""
    variances = covariance.diagonal(dim1=1, dim2=2).clamp(min=0.0)
    return torch.stack([variances[:, :3].sum(1), variances[:, 3:].sum(1)], 1).sqrt()


def _sizes(deviations: Tensor) -> tuple[str, str]:
    """Root mean squares over rows (M, 2) of positions and orientations."""
    shift, turn = deviations.square().mean(0).sqrt().tolist()
    return f"{1e3 * shift:.3f} mm", f"{degrees(turn):.4f} deg"


def _missed_lines(found: Compensation, tools: list[ToolOnTip], lines: list[int]) -> Iterator[str]:
    """Sentences about the first rows that are not reached."""
    missed = (~found.reached).nonzero().flatten().tolist()
    for row in missed[:MOST_MISSED]:
        if not bool(found.q[row].isfinite().all()):
            yield f"  line {lines[row]}: {found.status[row]}, no command is allowed: it starts beyond a joint's limit"
            continue
        misses = ", ".join(filter(None, (_miss(found, tool, row) for tool in tools)))
        status = str(found.status[row])
        yield f"  line {lines[row]}: {REASONS.get(status, status)}, {misses}"
    if len(missed) > MOST_MISSED:
        yield f"  and {len(missed) - MOST_MISSED} more; see the column `status`"


def _miss(found: Compensation, tool: ToolOnTip, row: int) -> str:
    """How far a tool is from its target; nothing if it has none."""
    distance = float(tool.own(found.miss)[row])
    if isnan(distance):
        return ""
    degrees_off = _degrees(found, tool)
    angle = "" if degrees_off is None else f" and {float(degrees_off[row]):.4f} deg"
    who = "misses" if tool.place is None else f"{tool.tip} misses"
    return f"{who} by {1e3 * distance:.4f} mm{angle}"
