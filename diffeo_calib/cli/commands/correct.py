"""`diffeo-calib correct`: a program whose commands bring the calibrated robot to the intended poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import degrees, isnan, radians
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.cli.console import out, plain, progress_bar, record, say, text_table
from diffeo_calib.cli.declarations import CorrectOptions
from diffeo_calib.cli.models import as_fitted, load_laden, tool_in_tip
from diffeo_calib.cli.tables import as_written, of_robot, table_format, targets_of, with_rotation
from diffeo_calib.common.checks import check_number
from diffeo_calib.common.errors import InputError, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.compensation.compensate import Compensation, compensate
from diffeo_calib.kinematics.evaluation import refuse_other_angles, warn_outside_range
from diffeo_calib.kinematics.tool import checked_tip, covariance_without_placement, tool_transform
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.files import read_joints
from diffeo_calib.measurements.csv.lines import Column, read_cells, write_columns
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.measurements.table_format import TableFormat, flat_names
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.tree import Tree

AXES_OF_A_PLACE, AXES_OF_A_POSE = 3, 6
SAME = 1e-9  # m, of poses a whole turn apart: joints that follow by another ratio are elsewhere
ROWS_AT_ONCE = 100  # rows whose deviations are predicted together
REASONS = {
    "unreachable": "unreachable with corrections within --limit",
    "singular": "singular: near a singularity it needs a correction larger than --limit",
}
"""Statuses in words: the largest correction is part of them."""
MOST_MISSED = 10  # most lines about rows that are not reached


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

    def own(self, values: Any) -> Any:
        """Its own part of a result; None of none."""
        return values if self.place is None or values is None else values[:, self.place]

    def name(self, before: str, after: str) -> str:
        """Name of a column: with that of the tip where there are several."""
        return f"{before}_{after}" if self.place is None else f"{before}_{self.tip}_{after}"

    def pose_names(self, table: TableFormat) -> list[str]:
        """Columns of the pose to command."""
        return [self.name("command", name) for name in ("x", "y", "z", *flat_names(table.rotation))]

    def added(
        self, robot: Tree, solution: Compensation, region: tuple[Tensor, Tensor] | None, table: TableFormat
    ) -> dict[str, Column]:
        """Its pose, misses and standard deviation, NaN where there is no command or no target."""
        allowed, names = solution.q.isfinite().all(1), self.pose_names(table)
        numbers = solution.q.new_full((len(solution), len(names) + 1), torch.nan)
        if region is not None:
            poses, unit = self.nominal(robot, solution.q[allowed]), table.rotation_angle or "rad"
            turned = rotation_numbers(poses[:, :3, :3], table.convention or "rotvec", angle=unit)
            parts = poses[:, :3, 3] * table.per_metre, turned, region[0][:, :1] * table.per_metre
            numbers[allowed] = torch.cat(parts, dim=1)
        *pose, deviation = numbers.mT.tolist()
        added = dict[str, Column](zip(names, pose, strict=True))
        added["status"] = list(map(str, solution.status))
        added[self.name("miss", table.length)] = (self.own(solution.miss) * table.per_metre).tolist()
        angle = self.own(solution.angle_miss)
        if angle is not None:
            turned = angle.rad2deg() if table.angle == "deg" else angle
            added[self.name("angle_miss", table.angle)] = turned.tolist()
        return added | {self.name("std", table.length): deviation}


def run(options: CorrectOptions) -> None:
    """Read a program, correct it, write it and print a summary; units that are not typed are those of the fit."""
    _check(options)
    model = load_laden(options.model, options.payload)
    read = of_robot(table_format(as_fitted(model, options, options.program)), model.robot)
    table, tips = with_rotation(read, options), options.tip or ()
    if len(tips) == 1:
        model = model.with_tool(model.tool, *tips)
    turned = replace(read, convention=options.convention, rotation_angle=options.rotation_angle)
    robot, tools = model.robot, _tools(model, options, turned)
    before, columns = Columns.of(table.joints_only()), Columns.of(as_written(table).joints_only())
    sheet = read_cells(options.program, table.sep, before.names)
    if before.names != columns.names:  # of a function: they would be those of the program before
        sheet = sheet.without(before.names)
        sheet.check_free(columns.names)
    start, targets = read_joints(options.program, table), targets_of(options.program, read, options, len(tools))
    for tool in tools:
        misses = [tool.name("angle_miss", table.angle)] if targets is None or targets.ndim == 4 else []
        misses += ["status", tool.name("miss", table.length), tool.name("std", table.length)]
        sheet.check_free([*tool.pose_names(table), *misses])
    refuse_other_angles(model, start)
    start = _within_limits(robot, start)
    warn_outside_range(model, start)
    if targets is None:
        targets = torch.stack([tool.nominal(robot, start) for tool in tools], dim=1)
        few = robot.n < AXES_OF_A_POSE * len(tools)
        if few and (is_cartesian(robot) or robot.n >= AXES_OF_A_PLACE * len(tools)):
            targets = targets[..., :3, 3]
            held = "" if is_cartesian(robot) else f": {robot.n} joints cannot hold every orientation"
            say(f"positions are corrected, without orientations{held}")
    bound, rate = (None if angle is None else radians(angle) for angle in (options.limit, options.rate))
    how = {"frame": options.frame, "bound": bound, "path": rate is not None, "rate": rate}
    with progress_bar() as progress:
        progress("commands", 0, 1)
        program = compensate(model, _goals(robot, tools, targets), start, tool=_places(robot, tools), **how)
    allowed = program.q.isfinite().all(1)
    some = bool(allowed.any())
    regions = [tool.known(model, program.q[allowed], options.frame) if some else None for tool in tools]
    added = dict[str, Column]()
    for tool, pair in zip(tools, regions, strict=True):
        added |= tool.added(robot, program, pair, table)
    place = {"command": 0, "status": 1, "miss": 2, "angle": 2, "std": 3}
    added = {name: added[name] for name in sorted(added, key=lambda name: place[name.split("_")[0]])}
    write_columns(options.output, sheet, columns.cells(program.q, {}) | added, table)
    misses = {tool.tip: {"miss_m": tool.own(program.miss), "angle_miss_deg": _degrees(program, tool)} for tool in tools}
    record.add(rows=len(program), statuses=program.counts, misses=misses, files={"program": options.output})
    _summarise(robot, program, tools, [line for line, _ in sheet.rows])
    where = "robot's base" if options.frame == "base" else "measuring frame"
    say(*(_how_well_known(tool, *pair, where) for tool, pair in zip(tools, regions, strict=True) if pair is not None))
    frames = ", ".join(f"of the tool on {tool.tip}, in the frame of {robot.base}" for tool in tools)
    corrected = f"{len(program)} rows written to {options.output}: corrected {', '.join(columns.names)}"
    say(f"{corrected}, the pose to command ({frames}), status, miss and standard deviation")


def _check(options: CorrectOptions) -> None:
    for name, value in (("--limit", options.limit), ("--rate", options.rate)):
        if value is not None:
            check_number(value, name, above=0.0)
    if options.frame == "measuring" and not options.position:
        fix = "leave it out, or name the columns of the targets (--position)"
        raise InputError.of("--frame measuring: the nominal poses of commands are in the robot's base", fix=fix)


def _within_limits(robot: Tree, start: Tensor) -> Tensor:
    """Commands (N, n) less whole turns where these bring a joint within its limits, and the pose is the same."""
    low, high = robot.limits.unbind(1)
    inside = start - robot.whole_turns(start)
    turned = ((start < low) | (start > high)) & (inside >= low) & (inside <= high)
    turned &= (robot(torch.where(turned, inside, start)) - robot(start)).flatten(1).abs().amax(1, keepdim=True) < SAME
    if names := [name for name, some in zip(robot.joint_names, turned.any(0).tolist(), strict=True) if some]:
        say(f"{', '.join(names)}: whole turns beyond the limits were taken off")
    return torch.where(turned, inside, start)


def _tools(model: CalibratedKinematics, named: CorrectOptions, table: TableFormat) -> list[ToolOnTip]:
    robot, tips = model.robot, named.tip or []
    if named.tool and len(named.tool) != max(len(tips), 1):
        expected, fix = f"{max(len(tips), 1)} of them", "give one tool for every --tip"
        raise InputError.of("--tool", expected=expected, got=len(named.tool), fix=fix)
    numbers = named.tool or [None] * max(len(tips), 1)
    if len(tips) < 2:
        tip = checked_tip(robot, model.tool_tip)
        return [ToolOnTip(tip, tool_in_tip(model, numbers[0], table))]
    placed = []
    for k, (tip, text) in enumerate(zip(tips, numbers, strict=True)):
        if tip in tips[:k]:
            raise InputError.of(f"--tip {tip} is named twice", fix="name every tip once")
        mounted = model.tool if checked_tip(robot, tip) == model.tool_tip else None
        tool = tool_in_tip(model.with_tool(mounted, tip), text, table)
        placed.append(ToolOnTip(tip, tool, robot.tips.index(tip)))
    return placed


def _goals(robot: Tree, tools: list[ToolOnTip], targets: Tensor) -> Tensor:
    """Targets (N, T, ...) of the tools for :func:`compensate`, NaN for the robot's other tips."""
    if tools[0].place is None:
        return targets[:, 0]
    goals = targets.new_full((len(targets), len(robot.tips), *targets.shape[2:]), torch.nan)
    goals[:, [tool.place for tool in tools]] = targets
    return goals


def _places(robot: Tree, tools: list[ToolOnTip]) -> Tensor:
    """The tool (4, 4), or those of all tips (T, 4, 4)."""
    by_tip = {tool.tip: tool.tool for tool in tools}
    only = tools[0].place is None
    return tools[0].tool if only else torch.stack([by_tip.get(tip, tool_transform(None)) for tip in robot.tips])


def _degrees(solution: Compensation, tool: ToolOnTip) -> Tensor | None:
    """Angles (N,) of the tool from its targets, NaN where it has none; None for targets without orientation."""
    return None if solution.angle_miss is None else tool.own(solution.angle_miss).rad2deg()


def _summarise(robot: Tree, solution: Compensation, tools: list[ToolOnTip], lines: list[int]) -> None:
    allowed = solution.q.isfinite().all(1)
    if bool(allowed.any()):
        sizes, change = dict[str, Tensor](), solution.correction[allowed].abs()
        for tool in tools:
            after, before = (tool.nominal(robot, q[allowed])[:, :3, 3] for q in (solution.q, solution.start))
            label = "tool" if tool.place is None else f"tool on {tool.tip}"
            sizes[f"{label}, mm"] = 1e3 * (after - before).norm(dim=1)
        for name, turns, moved in zip(robot.joint_names, robot.periodic, change.mT, strict=True):
            sizes[f"{name}, {'deg' if turns else 'mm'}"] = moved.rad2deg() if turns else 1e3 * moved
        rows = [[plain(what), f"{float(own.median()):.4f}", f"{float(own.max()):.4f}"] for what, own in sizes.items()]
        out.print(text_table("Corrections", ["", "median", "max"], rows))
    say(f"{len(solution)} rows: " + ", ".join(f"{count} {name}" for name, count in solution.counts.items()))
    say(*_missed_lines(solution, tools, lines))
    few_joints = robot.n < AXES_OF_A_POSE * len(tools) and solution.angle_miss is not None
    if few_joints and 2 * int(solution.reached.sum()) < len(solution):
        of_tools = "" if len(tools) == 1 else f" of {len(tools)} tools"
        what = f"a robot with {robot.n} joints cannot hold every orientation{of_tools}"
        warn_user(sentence(what, fix="name target positions instead (--position)"))
    elif 2 * solution.counts.get("unreachable", 0) > len(solution):
        what = "most targets are farther from their commands than the largest correction allows"
        warn_user(sentence(what, fix="check the frame, the unit and the columns of the targets, and --tool"))


def _how_well_known(tool: ToolOnTip, whole: Tensor, apart: Tensor, where: str) -> str:
    """How well the model knows a tool, by deviations (N, 2) as of :meth:`ToolOnTip.known`: misses are the model's."""
    label, (shift, turn) = "tool" if tool.place is None else f"tool on {tool.tip}", _sizes(whole)
    said = f"statuses and misses are those of the model, which knows the {label} in the {where} to {shift}, and its "
    said += f"orientation to {turn} (standard deviations)"
    if float(apart.square().sum(0)[0]) >= float(whole.square().sum(0)[0]):  # as far from the rows of the fit
        return said
    said += "; apart from where the base stands and how the tool sits on its flange, which are the same for all "
    return said + "commands and can be taught anew, to {} and {}".format(*_sizes(apart))


def _deviations(covariance: Tensor) -> Tensor:
    """Standard deviations (M, 2) of positions and orientations, m and rad, of covariances (M, 6, 6)."""
    variances = covariance.diagonal(dim1=1, dim2=2).clamp(min=0.0)
    return torch.stack([variances[:, :3].sum(1), variances[:, 3:].sum(1)], 1).sqrt()


def _sizes(deviations: Tensor) -> tuple[str, str]:
    shift, turn = deviations.square().mean(0).sqrt().tolist()
    return f"{1e3 * shift:.3f} mm", f"{degrees(turn):.4f} deg"


def _missed_lines(solution: Compensation, tools: list[ToolOnTip], lines: list[int]) -> Iterator[str]:
    missed = (~solution.reached).nonzero().flatten().tolist()
    for row in missed[:MOST_MISSED]:
        status, misses = str(solution.status[row]), list[str]()
        for tool in tools:
            distance, angle = float(tool.own(solution.miss)[row]), _degrees(solution, tool)
            turned = "" if angle is None else f" and {float(angle[row]):.4f} deg"
            who = "" if tool.place is None else f"{tool.tip} "
            misses += [] if isnan(distance) else [f"{who}misses by {1e3 * distance:.4f} mm{turned}"]
        words = f"{REASONS.get(status, status)}, {', '.join(misses)}"
        if not bool(solution.q[row].isfinite().all()):
            words = f"{status}, no command is allowed: it starts beyond a joint's limit"
        yield f"  line {lines[row]}: {words}"
    if len(missed) > MOST_MISSED:
        yield f"  and {len(missed) - MOST_MISSED} more; see the column `status`"
