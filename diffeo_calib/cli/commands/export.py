"""`diffeo-calib export`: a model in the formats of other programs, and the accuracy that each keeps."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from math import hypot
from pathlib import Path

import typer
from torch import Tensor

from diffeo_calib.calibration.expected_errors import ExpectedError, stands_free
from diffeo_calib.cli.console import make_folder, out, plain, record, say, text_table
from diffeo_calib.cli.declarations import ExportOptions
from diffeo_calib.cli.models import load_laden, tool_in_tip
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.files import write_together
from diffeo_calib.interop import rigid as fitted
from diffeo_calib.interop import tables as controller
from diffeo_calib.interop.c_source import CFiles, write_c
from diffeo_calib.interop.camera_files import camera_files
from diffeo_calib.interop.dh import DHTable, dh_table, dh_text, ur_text, ur_transforms
from diffeo_calib.interop.torch_program import export_onnx, export_torch
from diffeo_calib.interop.urdf import corrected_urdf, mjcf_text, urdf_of
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.bodies import placement_lines
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.sensors.known_drift import KnownDrift

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


def run(given: ExportOptions) -> None:
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
        _show(export.model, export.rows)
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


def _show(model: CalibratedKinematics, rows: Mapping[str, fitted.RigidKinematics]) -> None:
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
