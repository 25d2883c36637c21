"""`diffeo-calib correct`: a program whose commands bring the calibrated robot to the intended poses.

`export`: a model in the formats of other programs, and the accuracy that each keeps.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import degrees, hypot, isnan, radians
from pathlib import Path
from typing import Any

import torch
import typer
from torch import Tensor

from diffeo_calib.calibration.expected_errors import ExpectedError, stands_free
from diffeo_calib.cli.console import make_folder, out, plain, progress_bar, record, say, text_table
from diffeo_calib.cli.declarations import CorrectOptions, ExportOptions
from diffeo_calib.cli.models import as_fitted, load_laden, tool_in_tip
from diffeo_calib.cli.tables import as_written, of_robot, table_format, targets_of, with_rotation
from diffeo_calib.common.checks import check_number
from diffeo_calib.common.errors import InputError, sentence, warn_user
from diffeo_calib.common.files import write_together
from diffeo_calib.interop import rigid as fitted
from diffeo_calib.interop import tables as controller
from diffeo_calib.interop.c_source import CFiles, write_c
from diffeo_calib.interop.camera_files import camera_files
from diffeo_calib.interop.dh import DHTable, dh_table, dh_text, ur_text, ur_transforms
from diffeo_calib.interop.torch_program import export_onnx, export_torch
from diffeo_calib.interop.urdf import corrected_urdf, mjcf_text, urdf_of
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.compensation.compensate import Compensation, compensate
from diffeo_calib.kinematics.evaluation import refuse_other_angles, warn_outside_range
from diffeo_calib.kinematics.tool import checked_tip, covariance_without_placement, tool_transform
from diffeo_calib.measurements.bodies import placement_lines
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.files import read_joints
from diffeo_calib.measurements.csv.lines import Column, read_cells, write_columns
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.measurements.table_format import TableFormat, flat_names
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.known_drift import KnownDrift

AXES_OF_A_POSE = 6
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
    warn_outside_range(model, start)
    if targets is None:
        targets = torch.stack([tool.nominal(robot, start) for tool in tools], dim=1)
        if is_cartesian(robot) and robot.n < AXES_OF_A_POSE:  # commanded places
            targets = targets[..., :3, 3]
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


MEGABYTE = 1e6
RIGID = ("--urdf", "--mjcf", "--dh", "--ur-kinematics")
NOMINAL = "nominal robot, registered"
OFFSETS = "joint offsets: reading + offset is the joint value for nominal kinematics; they hold no other error"
FIELD = (
    "field: a controller adds add_x, ... to the place that it is to reach; std_x, ... say how well",
    "  each is known; between the points interpolate linearly",
)
TOGETHER = "they are for use together with the correction tables: write files that are used alone without these"
HASH = re.compile(r"^ *hash: *((?!diffeo_calib_)[A-Za-z]\w*)", re.ASCII | re.MULTILINE)
"""The hash of a robot, not of a file that was written before."""
UR_HASH = (
    "the UR driver compares the entry hash with the controller's and will report another calibration: "
    "write --ur-kinematics over a copy of the robot's own calibration file, whose hash it keeps"
)


class _Export:
    """One run of the command: texts first, so that nothing is written if one of them cannot be made.

    Attributes:
        files: option -> content. rows: what the printed table compares. lines: sentences below it.
        geometry: the rigid kinematics that are written; None for none.
    """

    def __init__(self, model: CalibratedKinematics, given: ExportOptions) -> None:
        self.model, self.given = model, given
        self.files: dict[str, bytes] = {}
        self.rows: dict[str, fitted.RigidKinematics] = {NOMINAL: fitted.with_errors(model, None)}
        self.lines: list[str] = []
        self.geometry: Geometry | None = None

    def rigid(self, options: list[str], *, tables: bool) -> None:
        """URDF, DH table and UR kinematics: three forms of the same rigid kinematics."""
        urdf = urdf_of(self.model.robot, self.given.robot) if {"--urdf", "--ur-kinematics"} & {*options} else b""
        new = self.given.urdf
        if new is not None and new.is_file() and new.read_bytes() == urdf:
            fix = "name another file: later fits need the robot as it is now"
            raise InputError.of(f"--urdf {new} is the robot's own URDF", fix=fix)
        rigid = fitted.rigid_kinematics(self.model, transmission=tables)
        self.geometry, name = rigid.geometry, ", ".join(options)
        self.rows |= {f"{name} and --correction-tables" if tables else name: rigid}
        if tables:
            self.rows[f"{name} alone"] = fitted.with_errors(self.model, rigid.geometry.joint_errors, rigid.how)
        self.lines += [TOGETHER] * tables
        said = ", ".join(f"{name} {1e3 * rms:.4f} mm" for name, rms in rigid.validated.items())
        self.lines.append(f"rigid kinematics from the {rigid.how} (cross-validated: {said})")
        self.lines.append("rigid kinematics hold no gravity sag, no transmission errors and no other deformations")
        frame = "that of the model" if stands_free(self.model) else "the measuring frame"
        placed = placement_lines(rigid.geometry, poses=self.model.lever is not None, frame=frame)
        self.lines += [f"  their {line}" for line in placed]
        self.lines.append("  (they belong to these files: plan with them or send commands of `correct`, never both)")
        for option in options:
            self.files[option] = self._text(option, rigid.geometry, urdf).encode("utf-8", "surrogateescape")

    def _text(self, option: str, geometry: Geometry, urdf: bytes) -> str:
        if option == "--dh":
            table = dh_table(geometry, self.given.dh_convention, self.given.tip or self.model.tool_tip)
            self.lines += _dh_lines(table, self.given)
            return dh_text(table, self.given.length, self.given.angle)
        if option == "--mjcf":
            return mjcf_text(geometry)
        if option == "--urdf":
            return corrected_urdf(geometry, urdf).decode("utf-8", "surrogateescape")
        before, match = self.given.ur_kinematics, None
        if before is not None and before.is_file():
            match = HASH.search(before.read_bytes().decode(errors="replace"))
        self.lines += [UR_HASH] * (match is None)
        return ur_text(ur_transforms(geometry, urdf), match and match[1])

    def tables(self, wanted: Mapping[str, Path]) -> None:
        """Joint offsets alone, correction tables for the nominal robot, corrections on a grid."""
        length, angle = self.given.length, self.given.angle
        if "--joint-offsets" in wanted:
            offsets = fitted.best_joint_offsets(self.model)
            self.rows["--joint-offsets"] = offsets.rigid
            self.files["--joint-offsets"] = controller.offsets_text(offsets, self.model.robot, length, angle).encode()
            self.lines.append(OFFSETS)
        if "--correction-tables" in wanted:
            tables = controller.correction_tables(self.model)
            self.rows["--correction-tables, nominal robot"] = fitted.with_errors(self.model, None, transmission=True)
            self.files["--correction-tables"] = controller.tables_text(tables, length, angle).encode()
            self.lines += _table_lines(tables)
        if "--field" in wanted:
            self.files["--field"] = controller.field_text(self.model, self.given.grid, length).encode()
            self.lines += FIELD

    def camera(self, folder: Path) -> dict[Path, bytes]:
        """The files of the camera; its place belongs to the rigid kinematics, if any are written."""
        made = self.model.provenance
        words = [] if made is None else shlex.split(made.command or "")
        files = camera_files(self.model, self.geometry, on_tool="--camera-on-tool" in words if words else None)
        make_folder(folder)
        belongs = "the calibrated model" if self.geometry is None else "the rigid kinematics written beside it"
        self.lines.append(f"camera: {', '.join(files)} in {folder}; its place belongs to {belongs}")
        return {folder / name: text.encode() for name, text in files.items()}


def run_export(given: ExportOptions) -> None:
    """Write the files, then say what each leaves of the model."""
    files = {one.shown: getattr(given, one.field) for one in given.all() if one.kind in ("write", "source", "folder")}
    wanted: dict[str, Path] = {option: path for option, path in files.items() if path is not None}
    if not wanted:
        raise typer.BadParameter(f"name at least one file to write: {', '.join(files)}")
    model = load_laden(given.model, given.payload)
    in_tip = tool_in_tip(model, given.tool, TableFormat(given.length, given.angle))
    tool = None if given.tool is None else in_tip
    source = given.c and write_c(model, given.c, tool, given.frame or "base", tip=given.tip, write=False)
    export, rigid = _Export(model, given), [option for option in wanted if option in RIGID]
    if rigid:
        export.rigid(rigid, tables="--correction-tables" in wanted)
    export.tables(wanted)
    camera = export.camera(wanted["--camera"]) if "--camera" in wanted else {}
    texts = {} if source is None else source.contents
    write_together({wanted[option]: content for option, content in export.files.items()} | texts | camera)
    record.add(files={option[2:]: target for option, target in wanted.items()})
    if len(export.rows) > 1:
        _show_distances(export.model, export.rows)
    say(*export.lines, *_limits(model, rigid), *(f"{option[2:]}: {wanted[option]}" for option in export.files))
    for line in _write_programs(model, given, tool, source):
        say(line)


def _write_programs(
    model: CalibratedKinematics, given: ExportOptions, tool: Tensor | None, source: CFiles | None
) -> Iterator[str]:
    """Write the programs that are no texts, of the tool (4, 4), m, in the tip's frame; a sentence about each program.

    ``source`` is what was written in C.
    """
    frame, named = given.frame or "base", not (tool is None and given.frame is None)
    if source is not None:
        files = f"{source.source} ({len(source.texts[0]) / MEGABYTE:.1f} MB), {source.header.name}"
        yield f"c: {files}: {', '.join(source.functions)}, in the frame {frame!r}"
    output = "tool_poses" if named else "points"
    what = f"poses of the tool in the frame {frame!r}" if named else "markers in the measuring frame"
    for name, target, export in (("torch", given.torch, export_torch), ("onnx", given.onnx, export_onnx)):
        if target is not None:
            export(model, target, output, tool=tool, frame=frame)
            yield f"{name}: {target} ({target.stat().st_size / MEGABYTE:.1f} MB): {what}"


def _limits(model: CalibratedKinematics, rigid: Sequence[str]) -> Iterator[str]:
    """Directions that the rows leave open: base and tool of rigid kinematics are right only together. And a drift."""
    if rigid and (places := ExpectedError.of(model).open_places):
        yield (
            f"the rows of the fit leave {' and '.join(places)} open: base and tool of these files may both stand apart "
            "from the model's along it; use them together, at poses like those of the fit"
        )
    drift = KnownDrift.of(model)
    if drift is not None:  # which the files do not know
        yield from drift.of_joints()
        yield f"no file knows the {' or the '.join(drift.names)}: they hold at {drift.holds()}"


def _show_distances(model: CalibratedKinematics, rows: Mapping[str, fitted.RigidKinematics]) -> None:
    summary = model.summary
    about, new = (None if summary is None else summary.leave_one_out_rms), "new measurements, about"
    if about is None or stands_free(model):  # no position was measured
        about, new = ExpectedError.of(model).whole, "true positions, about"
    title = f"Distance from the model over {fitted.Compared.of(model).where}, mm"
    lines: list[tuple[str, list[float | None]]] = []
    for name, rigid in rows.items():
        left_out = rigid.validated.get(rigid.how)
        lines.append((plain(name), [rigid.rms, rigid.largest, left_out, hypot(left_out or rigid.rms, about)]))
    lines.append(("(the model itself)", [None, None, None, about]))
    cells = [[name, *("" if rms is None else f"{1e3 * rms:.4f}" for rms in numbers)] for name, numbers in lines]
    out.print(text_table(title, ["export", "RMS", "max", "cross-validated", new], cells))
    if summary is not None and summary.geometry_rms is not None and summary.diffeomorphic_rms is not None:
        left = f"geometric calibration {1e3 * summary.geometry_rms:.4f}, model {1e3 * summary.diffeomorphic_rms:.4f}"
        say(f"RMS distance from the measured positions of the fit, mm: {left}")


def _dh_lines(table: DHTable, given: ExportOptions) -> Iterator[str]:
    for name, transform in (("base", table.base), ("tool", table.tool)):
        numbers = zip(controller.origin_numbers(transform), (given.length, given.angle), strict=True)
        each = ((controller.in_unit(values, unit), unit) for values, unit in numbers)
        words = [f"{' '.join(f'{value:.6g}' for value in values)} {unit}" for values, unit in each]
        yield f"DH {name} (x y z, roll pitch yaw): {', '.join(words)}"
    parallel = [name for name, row in zip(table.names, table.rows, strict=True) if row.beta]
    if parallel:
        yield f"DH rows with Hayati's beta, next to parallel axes: {', '.join(parallel)}"


def _table_lines(tables: list[controller.CorrectionTable]) -> Iterator[str]:
    yield "correction tables: a controller adds the correction to the joint value that it is to reach"
    yield "  they hold transmission errors of single joints, neither geometric errors nor gravity sag"
    yield "  only measured joint values are in the tables; nothing is known beyond them"
    for table in tables:
        unit = "urad" if table.turns else "um"
        size, between = 1e6 * float(table.corrections.abs().max()), 1e6 * table.between
        rows = f"{table.joint}: {len(table.values)} rows, corrections up to {size:.1f} {unit}"
        yield f"  {rows}, linear interpolation within {between:.2g} {unit}"
