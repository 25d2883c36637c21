"""`diffeo-calib export`: a model in the formats of other programs, and the accuracy that each keeps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import hypot
from pathlib import Path

from rich.table import Table
from torch import Tensor

from diffeo_calib.calibration.expected_errors import expected_of, stands_free
from diffeo_calib.cli.commands.export_programs import Programs, Tool
from diffeo_calib.cli.console import out, plain, say
from diffeo_calib.cli.error_tables import placement_lines
from diffeo_calib.cli.models import load_laden, tool_in_tip
from diffeo_calib.cli.record import record
from diffeo_calib.common.files import write_together
from diffeo_calib.interop.dh import DHTable, dh_table, dh_text
from diffeo_calib.interop.files import angles, lengths, origin_numbers
from diffeo_calib.interop.joint_tables import CorrectionTable, correction_tables, offsets_text, tables_text
from diffeo_calib.interop.rigid import (
    RigidKinematics,
    applied_with_tables,
    best_joint_offsets,
    nominal_kinematics,
    rigid_kinematics,
)
from diffeo_calib.interop.ur_kinematics import ur_text, ur_transforms
from diffeo_calib.interop.urdf import corrected_urdf, urdf_of
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.geometry import Geometry

RIGID = ("--urdf", "--dh", "--ur-kinematics")
NOMINAL = "nominal robot, registered"


@dataclass(frozen=True)
class Formats:
    """How the files are written.

    Args:
        convention: of the Denavit-Hartenberg table. length, angle: units of CSV files.
        ur_hash: entry of the kinematics file of Universal Robots' packages, None for an own one.
        tool: text of the tool centre point of programs; None for the model's own. tool_from: "tip" or "measured".
        frame: of its poses; None for the robot's base.
        tip: at the end of C programs and Denavit-Hartenberg tables; None for the only one, or the model's own.
    """

    convention: str
    length: str
    angle: str
    ur_hash: str | None
    tool: str | None = None
    tool_from: str = "tip"
    frame: str | None = None
    tip: str | None = None

    def programs_tool(self, model: CalibratedKinematics) -> Tool:
        """The tool of programs.

        Raises:
            InputError: a text that is no tool centre point.
        """
        given = tool_in_tip(model, self.tool, self.tool_from, TableFormat(self.length, self.angle))
        return Tool(None if self.tool is None else given, self.frame)


class _Export:
    """One run of the command: texts first, so that nothing is written if one of them cannot be made.

    Attributes:
        files: option -> content. rows: what the printed table compares. lines: sentences below it.
    """

    def __init__(self, model: CalibratedKinematics, formats: Formats, robot: Path | None) -> None:
        self.model, self.formats, self.robot = model, formats, robot
        self.files: dict[str, bytes] = {}
        self.rows: dict[str, RigidKinematics] = {NOMINAL: nominal_kinematics(model)}
        self.lines: list[str] = []

    def rigid(self, options: list[str], *, with_tables: bool, tables: bool) -> None:
        """URDF, DH table and UR kinematics: three forms of the same rigid kinematics."""
        urdf = None if options == ["--dh"] else urdf_of(self.model.robot, self.robot)
        found = rigid_kinematics(self.model, transmission=with_tables)
        together = " and --correction-tables"
        if with_tables:
            self.rows[", ".join(options) + together] = found
            self.rows[f"{', '.join(options)} alone"] = applied_with_tables(self.model, found, applied=False)
        else:
            self.rows[", ".join(options)] = found
            if tables:
                self.rows[", ".join(options) + together] = applied_with_tables(self.model, found, applied=True)
                self.lines.append("to use them together with the tables, fit them for that: --with-tables")
        said = ", ".join(f"{name} {1e3 * rms:.4f} mm" for name, rms in found.validated.items())
        self.lines.append(f"rigid kinematics from the {found.how} (cross-validated: {said})")
        self.lines.append("rigid kinematics hold no gravity sag, no transmission errors and no other deformations")
        self.lines += [
            f"  their {line}" for line in placement_lines(found.geometry, poses=self.model.lever is not None)
        ]
        self.lines.append("  (base and markers belong to these kinematics: do not mix them with those of the model)")
        for option in options:
            self.files[option] = self._text(option, found.geometry, urdf).encode("utf-8", "surrogateescape")

    def _text(self, option: str, geometry: Geometry, urdf: bytes | None) -> str:
        if option == "--dh":
            table = dh_table(geometry, self.formats.convention, self.formats.tip or self.model.tool_tip)
            self.lines += _dh_lines(table, self.formats)
            return dh_text(table, self.formats.length, self.formats.angle)
        content = urdf or b""
        if option == "--urdf":
            return corrected_urdf(geometry, content).decode("utf-8", "surrogateescape")
        if self.formats.ur_hash is None:
            self.lines.append(
                "the UR driver compares the entry hash with the controller's and will report another calibration: "
                "pass the hash of the robot's own calibration file (--ur-hash)"
            )
        return ur_text(ur_transforms(geometry, content), self.formats.ur_hash)

    def offsets(self) -> None:
        """Joint offsets alone."""
        found = best_joint_offsets(self.model)
        self.rows["--joint-offsets"] = found.rigid
        text = offsets_text(found, self.model.robot, self.formats.length, self.formats.angle)
        self.files["--joint-offsets"] = text.encode()
        self.lines.append(
            "joint offsets: reading + offset is the joint value for nominal kinematics; they hold no other error"
        )

    def tables(self) -> None:
        """Correction tables, with the nominal robot."""
        tables = correction_tables(self.model)
        self.rows["--correction-tables, nominal robot"] = nominal_kinematics(self.model, transmission=True)
        text = tables_text(tables, self.formats.length, self.formats.angle)
        self.files["--correction-tables"] = text.encode()
        self.lines += _table_lines(tables)


def run(
    path: Path,
    outputs: Mapping[str, Path | None],
    formats: Formats,
    robot: Path | None,
    *,
    with_tables: bool,
    payload: float | None = None,
) -> None:
    """Write the files, then say what each leaves of the model.

    Args:
        path: the model. outputs: option -> file to write, None where one is not wanted. formats: how.
        robot: URDF in place of the model's own.
        with_tables: whether the rigid kinematics are fitted for use with the correction tables.
        payload: mass that the robot carries; None for a model without payloads.

    Raises:
        InputError: the model or the robot's description cannot be used, or a file cannot be written.
    """
    wanted = {option: target for option, target in outputs.items() if target is not None}
    model = load_laden(path, payload)
    tool = formats.programs_tool(model)
    export = _Export(model, formats, robot)
    tables = "--correction-tables" in wanted
    if rigid := [option for option in wanted if option in RIGID]:
        export.rigid(rigid, with_tables=with_tables, tables=tables)
    if "--joint-offsets" in wanted:
        export.offsets()
    if tables:
        export.tables()
    programs = Programs(export.model, wanted, tool, formats.tip)
    write_together({wanted[option]: content for option, content in export.files.items()} | programs.texts)
    record.add(files={option[2:]: target for option, target in wanted.items()})
    if export.files:
        _show(export.model, export.rows)
    for line in export.lines:
        say(line)
    for option in export.files:
        say(f"{option[2:]}: {wanted[option]}")
    for line in programs.write():
        say(line)


def _show(model: CalibratedKinematics, rows: Mapping[str, RigidKinematics]) -> None:
    """Print how far each export is from the model, and about how far from new measurements."""
    known = model.summary
    about, new = (None if known is None else known.leave_one_out_rms), "new measurements, about"
    if stands_free(model):  # errors of the fit are spreads or those of readings, which flatter
        about, new = expected_of(model), "true positions, about"
    title = f"Distance from the model over its {len(model.configurations)} measured configurations, mm"
    table = Table(title=title, title_justify="left")
    table.add_column("export")
    for column in ("RMS", "max", "cross-validated", *([new] if about is not None else [])):
        table.add_column(column, justify="right")
    for name, rigid in rows.items():
        left_out = rigid.validated.get(rigid.how)
        numbers = [rigid.rms, rigid.largest, left_out]
        if about is not None:
            numbers.append(hypot(left_out or rigid.rms, about))
        table.add_row(plain(name), *("" if number is None else f"{1e3 * number:.4f}" for number in numbers))
    if about is not None:
        table.add_row("(the model itself)", "", "", "", f"{1e3 * about:.4f}")
    out.print(table)
    if known:
        left = f"geometric calibration {1e3 * known.geometry_rms:.4f}, model {1e3 * known.diffeomorphic_rms:.4f}"
        of = "spread or errors of readings" if stands_free(model) else "RMS distance from the measurements"
        say(f"{of} of the fit, mm: {left}")


def _dh_lines(table: DHTable, formats: Formats) -> Iterator[str]:
    """Base and tool of a Denavit-Hartenberg table, and the joints with Hayati's parameter."""
    for name, transform in (("base", table.base), ("tool", table.tool)):
        yield f"DH {name} (x y z, roll pitch yaw): {_place(transform, formats)}"
    parallel = [name for name, row in zip(table.names, table.rows, strict=True) if row.beta]
    if parallel:
        yield f"DH rows with Hayati's beta, next to parallel axes: {', '.join(parallel)}"


def _place(transform: Tensor, formats: Formats) -> str:
    xyz, rpy = origin_numbers(transform)
    place = " ".join(f"{value:.6g}" for value in lengths(xyz, formats.length))
    turn = " ".join(f"{value:.6g}" for value in angles(rpy, formats.angle))
    return f"{place} {formats.length}, {turn} {formats.angle}"


def _table_lines(tables: list[CorrectionTable]) -> Iterator[str]:
    """Sign and range of the tables."""
    yield "correction tables: a controller adds the correction to the joint value that it is to reach"
    yield "  they hold transmission errors of single joints, neither geometric errors nor gravity sag"
    yield "  only measured joint values are in the tables; nothing is known beyond them"
    for table in tables:
        unit = "urad" if table.turns else "um"
        size, between = 1e6 * float(table.corrections.abs().max()), 1e6 * table.between
        rows = f"{table.joint}: {len(table.values)} rows, corrections up to {size:.1f} {unit}"
        yield f"  {rows}, linear interpolation within {between:.2g} {unit}"
