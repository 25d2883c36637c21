"""Model files that the commands read, and tables and lines about them: errors, places, expected errors, limits kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from math import inf, isnan
from pathlib import Path
from typing import Any, NamedTuple

import torch
import typer
from rich.console import Console, ConsoleOptions
from rich.table import Table
from torch import Tensor

from diffeo_calib.calibration.expected_errors import Accuracy, ExpectedError, expected_errors
from diffeo_calib.cli.console import plain, record, say, text_table
from diffeo_calib.cli.main import command_line
from diffeo_calib.cli.options import Links, Robot, Rows
from diffeo_calib.cli.tables import Given, MeasuredTable, as_at_the_fit, measured_table, rows_in_table, stated_numbers
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, few, sentence, warn_user
from diffeo_calib.common.files import PROGRAM, read_regular
from diffeo_calib.interop.model_file import load
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.registered_map import Registration
from diffeo_calib.measurements.bodies import marker_lines, transform_words, triple
from diffeo_calib.measurements.csv.cells import number
from diffeo_calib.measurements.csv.columns import PoseColumns
from diffeo_calib.measurements.csv.files import read_poses
from diffeo_calib.measurements.poses import POINTS, by_frame, rotation_matrices
from diffeo_calib.measurements.table_format import UNITS_PER_METRE, TableFormat, numbers_of
from diffeo_calib.robots.cartesian import cartesian
from diffeo_calib.robots.dh_file import DHFile
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import load_urdf
from diffeo_calib.robots.urdf_elements import LARGEST_FILE
from diffeo_calib.sensors.errors import SIZES, Evaluation, shown_unit
from diffeo_calib.sensors.kinds import known_kinds
from diffeo_calib.sensors.known_drift import KnownDrift


def load_kinematics(path: Path) -> CalibratedKinematics:
    """Load the model of a robot."""
    model = load(path)
    if not isinstance(model, CalibratedKinematics):
        raise InputError.of(f"{path} is not a robot's model", fix="pass a file written by `diffeo-calib fit`")
    return model


def load_robot(path: Path, links: Links) -> Tree:
    """The robot in a URDF, or in a table of Denavit-Hartenberg parameters."""
    tips = list(dict.fromkeys(links.tip or ()))
    if is_urdf(path):
        if links.dh_convention is not None:
            raise InputError.of(f"--dh-convention of a URDF, '{path}'", fix="leave it out")
        return load_urdf(path, links.base, tips or None, links.load or ())
    if links.base is not None or links.load or len(tips) > 1:
        what, expected = f"--base or --load of a DH table, '{path}'", "its whole chain, or one --tip"
        raise InputError.of(what, expected=expected, fix="leave them out, or pass a URDF")
    return DHFile.read(path).chain(links.dh_convention, *tips)


def robot_of(given: Robot, source: MeasuredTable) -> Tree:
    """The robot of a table: that of a file, or a machine whose commanded poses are in the table."""
    if isinstance(source.table.joints, PoseColumns):
        if given.robot is not None or any(getattr(given, name) for name in Links.names()):
            what, fix = "--robot, --base or --tip beside --robot-pose", "leave them out: poses are those of the flange"
            raise InputError.of(what, expected="joint values, or poses", got="both", fix=fix)
        return cartesian(read_poses(source.csv, source.table)[1])
    if given.robot is None:
        expected = "--robot FILE, or --robot-pose COLUMNS where the table has poses in place of joint values"
        fix = "of several lines that a campaign file proposes, uncomment one"
        raise InputError.of("the robot", expected=expected, got="neither", fix=fix)
    return load_robot(given.robot, given)


def is_urdf(path: Path) -> bool:
    """Whether a file is meant as a URDF."""
    if path.suffix.lower() in (".urdf", ".xml", ".xacro"):
        return True
    text = read_regular(path, "robot's description", LARGEST_FILE)
    return text.lstrip(b"\xef\xbb\xbf\xff\xfe\0 \t\r\n\v\f")[:1] == b"<"  # of any encoding, behind its mark


def load_laden(path: Path, mass: float | None) -> CalibratedKinematics:
    """The model of a robot that carries a mass, in the unit of its measurements; None for one without payloads."""
    model = load_kinematics(path)
    if model.payload is not None and mass is None:
        what = f"{path} was calibrated with payloads"
        raise InputError.of(what, expected="--payload", fix="name the mass that the robot carries, 0 without load")
    return model if mass is None else model.with_payload(mass)


def planned(model: CalibratedKinematics, mass: float | None) -> tuple[CalibratedKinematics, Tensor]:
    """A model to plan with, of a robot that carries a mass, by default the median of the fit; its markers (P, 3), m."""
    say(*provenance_lines(model))
    if mass is not None:
        model = model.with_payload(mass)
    elif model.payload is not None:
        say(f"planned with a payload of {model.payload:g}, the median of the fit; --payload for another one")
    return model, model.geometry.tool


def check_payload_column(model: CalibratedKinematics, column: str | None) -> None:
    """Raise InputError if only one of a model and a table has payloads."""
    if model.payload is None and column is not None:
        fix = "leave it out, or calibrate with payloads too"
        raise InputError.of(f"--payload {column}: the model was calibrated without payloads", fix=fix)
    if model.payload is not None and column is None:
        fix = "name the column of the table with the mass that the robot carries"
        raise InputError.of("the model was calibrated with payloads", expected="--payload", fix=fix)


def as_fitted(model: CalibratedKinematics, given: Given, csv: Path | None = None) -> Given:
    """Options of a command with a model, completed by those of the command that made it, see :func:`as_at_the_fit`."""
    made = model.provenance
    given = as_at_the_fit("" if made is None else made.command or made.table, given, csv)
    unit = given.joint_length or given.length
    if made is not None and made.program_rows and unit and PROGRAM in (given.robot_pose or ""):
        PoseColumns.of(given.robot_pose or "").check_program(made.program_rows, UNITS_PER_METRE[unit])
    return given


def table_of(model: CalibratedKinematics, csv: Path, given: Rows) -> MeasuredTable:
    """A table read as that of the model's fit unless options say otherwise, without kinds of rows that it lacks."""
    rows = as_fitted(model, given, csv)
    if not given.named:
        rows, missing = rows_in_table(csv, rows)
        if missing:
            say(f"the table has no columns of {few(missing)}: it is read without these rows of the fit")
    return measured_table(csv, rows)


def made_by_command(model: CalibratedKinematics, source: MeasuredTable | None = None) -> CalibratedKinematics:
    """The model with the command that runs in its provenance, and with what a function made of rows of its table."""
    if (made := model.provenance) is None:
        return model
    if source is not None and isinstance(columns := source.table.joints, PoseColumns) and columns.is_program:
        made = replace(made, program_rows=columns.program_rows(*read_poses(source.csv, source.table)))
    return model.changed(provenance=replace(made, command=command_line()))


def provenance_lines(model: CalibratedKinematics) -> Iterator[str]:
    """When the model was fitted and to what, if its file says so; what drifted then, and for when the model holds."""
    if model.provenance is not None:
        yield model.provenance.sentence(model.robot.name, len(model.configurations))
    drift = KnownDrift.of(model)
    if drift is not None:
        yield from drift.of_joints()


def another_date_lines(model: CalibratedKinematics) -> Iterator[str]:
    """How a drift of the fit is treated where new rows of another date are compared or joined with it."""
    drift = KnownDrift.of(model)
    if drift is not None:
        what = f"the drift with {' and '.join(drift.names)} is that of the rows of the fit"
        yield f"{what}: these rows meet the model as it was at {drift.holds()}"


LONGEST_TOOL_PER_REACH = 5.0  # from where a tool is refused: its unit is wrong

MEASURED = "measured:"  # before the numbers of a tool in the measured frame


def tool_in_tip(model: CalibratedKinematics, text: str | None, table: TableFormat) -> Tensor:
    """The tool centre point of --tool in the tip's frame: (4, 4) m; the model's own without a text."""
    if text is None:
        return model.tool
    convention = table.convention or "rotvec"
    count = 3 + numbers_of(convention)
    expected = f"X,Y,Z, or {count} numbers with the rotation as {convention!r}, separated by commas"
    values = stated_numbers("--tool", text.removeprefix(MEASURED), (3, count), expected)
    tool = torch.eye(4, dtype=torch.float64, device=HOST)
    tool[:3, 3] = torch.tensor(values[:3], dtype=torch.float64, device=HOST) / table.per_metre
    if len(values) == count:
        angle = table.rotation_angle or table.angle
        tool[:3, :3] = rotation_matrices([values[3:]], convention, angle=angle, place="--tool".format)[0]
    if (length := float(tool[:3, 3].norm())) > model.robot.reach:
        what, fix = f"--tool is {length:g} m long, more than the robot reaches", "check the unit (--length)"
        if length > LONGEST_TOOL_PER_REACH * model.robot.reach:
            raise InputError.of(what, expected=f"at most {model.robot.reach:.3g} m", fix=fix)
        warn_user(sentence(what, fix=fix))
    if not text.startswith(MEASURED):
        return tool
    tip = model.tool_tip or model.robot.tips[0]
    frames = [] if model.lever is None else list(by_frame(model.measured_frame[None])[0])
    on_tip = [frame for frame, name in zip(frames, model.on[::POINTS], strict=False) if name == tip]
    if len(on_tip) != 1:
        problem = f"{len(on_tip)} frames were measured on '{tip}'"
        problem = "this model was calibrated with points, which have no measured frame" if not frames else problem
        raise InputError.of(f"--tool {text}: {problem}", fix="give the tool in the frame of the tip (--tool X,Y,Z)")
    return on_tip[0] @ tool


EXIT_ABOVE = 4  # the errors are larger than --tolerance
UNITS = {"mm": ("m", 1e3), "um": ("m", 1e6), "m": ("m", 1.0), "px": ("px", 1.0)}
"""Unit of a limit -> unit in which it is compared, and how many are one of these; own kinds of readings have others."""


class ErrorTable:
    """Errors in their own unit, and of orientations in degrees, in a second table, if there are any.

    Args:
        rows: what each row is called -> its errors, all of one kind. of: whose they are, the end of the title.
        columns: names of the leading columns. expected: RMS, m, in a column of its own.
    """

    def __init__(
        self, rows: Mapping[tuple[str, ...], Evaluation], of: str, *columns: str, expected: float | None = None
    ) -> None:
        self.rows, self.of, self.columns, self.expected = rows, of, columns, expected

    def _table(self, title: str, *, angles: bool = False) -> Table:
        last = [self.expected] if self.expected is not None and not angles else []
        header, lines = [*self.columns, *([f"{size} deg" for size in SIZES] if angles else SIZES)], list[list[str]]()
        for labels, row in self.rows.items():
            numbers = [*row.each[angles].sizes, *(row.shown[1] * value for value in last)]
            lines.append([*labels, *("-" if isnan(value) else f"{value:.4f}" for value in numbers)])
        return text_table(title, [*header, *["expected RMS"] * len(last)], lines, len(self.columns))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        first = next(iter(self.rows.values()))
        yield self._table(f"{first.title} in {first.shown[0]} {self.of}")
        if first.orientation is not None:
            yield self._table(f"Orientation errors in deg {self.of}", angles=True)


def registration_lines(model: CalibratedKinematics) -> Iterator[str]:
    """Where measuring frame and markers were found, how well, and from how many rows."""
    motion = model.registration
    if motion is None:
        return
    yield from motion_lines(motion, model.on, doubt=": what else has changed is in them" * motion.doubtful)
    fitted = f"RMS {1e3 * motion.rms_after:.4f} mm on these rows, to which device and markers were fitted"
    left_out = f"{1e3 * motion.left_out_rms:.4f} mm with each row left out in turn"
    yield f"{motion.rows} rows took part: {fitted}; {left_out}"


def motion_lines(motion: Registration, tips: Sequence[str], *, doubt: str = "") -> Iterator[str]:
    """Where measuring frame and markers are now, and how far from where they were, as if the robot had not changed.

    With ``doubt``, what its change does to these places, no probability is stated: it would hold without one alone.
    """
    if motion.free != "marker":
        yield from frame_lines(motion)
    if motion.free != "base":
        tips = tips if len(tips) == len(motion.markers) else [tips[0]] * len(motion.markers)
        rigid = motion.lever is not None
        yield from marker_lines(motion.markers, tips, poses=rigid, std=None if rigid else motion.marker_deviations)
        if motion.shift is not None:
            largest = 1e3 * float(motion.shift.norm(dim=1).max())
            sure = f" (unmoved with probability {motion.same_place:.2f})" if motion.same_place is not None else ""
            yield f"  that is {largest:.3f} mm from where it was{sure * (not doubt)}"
    if doubt:
        yield f"  these places, and how well they are known, are those of a robot that has not changed{doubt}"


def frame_lines(motion: Registration, doubt: str = "") -> Iterator[str]:
    """Where the measuring frame is now; ``doubt`` as of :func:`motion_lines`."""
    yield f"the measuring frame of the model, seen from the new one: {transform_words(motion.transform)}"
    shift, turn = 1e3 * motion.frame_deviations[:3], torch.rad2deg(motion.frame_deviations[3:])
    known = f"  known to {triple(shift, '.2g')} mm at the middle of the rows, and to {triple(turn, '.2g')} deg"
    yield f"{known}, if the robot has not changed{doubt}" if doubt else known


def socket_lines(errors: Evaluation, rows: str) -> Iterator[str]:
    """Known distances and those found, for some rows."""
    for pair in errors.distances:
        between = f"distance of '{pair.first}' and '{pair.second}' ({rows})"
        yield f"{between}: {1e3 * pair.found:.3f} mm, known {1e3 * pair.known:.3f}, error {1e3 * pair.error:+.3f}"


def stage_line(
    model: CalibratedKinematics, stages: Mapping[str, Callable[[Tensor], Tensor]], expected: ExpectedError
) -> str:
    """The absolute errors that a model expects of every stage; they go into the record too."""
    by_stage = expected_errors(model, stages, expected)
    record.add(expected_error_by_stage_m=by_stage)
    listed = ", ".join(f"{name} {1e3 * value:.3f}" for name, value in by_stage.items())
    return f"expected absolute error by stage, in mm: {listed}"


def expectation_lines(model: CalibratedKinematics, data: Any, expected: ExpectedError | None = None) -> Iterator[str]:
    """The absolute error that a model expects, and which errors of the rows do not show it without a device."""
    alone, expected = model.map.workspace is not None, expected or ExpectedError.of(model)
    record.add(expected_error=expected.entry())
    fitted = ", after a rigid fit" * alone
    yield f"expected absolute error over the joint ranges of the fit{fitted}: {plain(expected.sentence)}"
    yield from dict.fromkeys(part.flattery for part in (() if data is None else data.parts) * alone)


class Limit(NamedTuple):
    """Largest error that is good enough, in ``unit``: m, px, or that of a kind of readings."""

    value: float
    unit: str


def parsed_limit(text: str | None) -> Limit | None:
    """A length with its unit, such as 0.15mm, or pixels; None without one."""
    if text is None:
        return None
    units = {kind.unit[0]: (kind.unit[0], 1.0) for kind in known_kinds().values()} | UNITS
    name = max((name for name in units if text.endswith(name)), key=len, default="")
    value = number(text.removesuffix(name).strip(), ".") if name else None
    if value is None or not 0.0 < value < inf:
        expected = "a length above zero with its unit, such as 0.15mm, or pixels, such as 0.5px"
        raise InputError.of(f"--tolerance {text}", expected=expected)
    unit, per_unit = units[name]
    return Limit(value / per_unit, unit)


def parsed_length(text: str | None) -> float | None:
    """A length with its unit in m; None without one."""
    limit = parsed_limit(text)
    if limit is not None and limit.unit != "m":
        raise InputError.of(f"--tolerance {text}", expected="a length, such as 0.15mm")
    return None if limit is None else limit.value


def accept(error: Accuracy, limit: Limit) -> None:
    """Say whether errors are within the limit; exit with a code of its own if they are not."""
    good = error.value <= limit.value
    record.add(**{f"rms_{error.unit}": error.value, f"limit_{error.unit}": limit.value}, accepted=good)
    unit, per_unit = shown_unit(error.unit)
    within = "within" if good else "above"
    say(f"RMS {per_unit * error.value:.4f} {unit} {error.of}: {within} the limit of {per_unit * limit.value:g} {unit}")
    if not good:
        raise typer.Exit(EXIT_ABOVE)
