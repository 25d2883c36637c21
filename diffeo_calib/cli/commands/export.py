"""`diffeo-calib export`: a model in the formats of other programs, and the accuracy that each keeps."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from pathlib import Path

from rich.table import Table

from diffeo_calib.cli.console import out, plain, say
from diffeo_calib.cli.error_tables import placement_lines
from diffeo_calib.cli.models import load_kinematics
from diffeo_calib.interop.rigid import RigidKinematics, nominal_kinematics, rigid_kinematics
from diffeo_calib.interop.urdf import corrected_urdf, urdf_of, write_bytes
from diffeo_calib.kinematics.calibrated import CalibratedKinematics

NOT_RIGID = "rigid kinematics hold no gravity sag, no transmission errors and no other deformation of the model"


@dataclass(frozen=True)
class Targets:
    """The files to write, None where one is not wanted."""

    urdf: Path | None = None


def run(path: Path, targets: Targets, robot: Path | None) -> None:
    """Write the files, then say what each leaves of the model.

    Raises:
        InputError: the model or the robot's description cannot be used, or a file cannot be written.
    """
    model = load_kinematics(path)
    rows = {"nominal robot, registered": nominal_kinematics(model)}
    lines: list[str] = []
    if targets.urdf is not None:
        urdf = urdf_of(model.robot, robot)
        rigid = rigid_kinematics(model)
        write_bytes(targets.urdf, corrected_urdf(rigid.geometry, urdf))
        rows["--urdf"] = rigid
        lines += [f"URDF: {targets.urdf}, joint origins from the {rigid.how}{_candidates(rigid)}; {NOT_RIGID}"]
        lines += [f"  its {line}" for line in placement_lines(rigid.geometry, poses=model.lever is not None)]
    _show(model, rows)
    for line in lines:
        say(line)


def _show(model: CalibratedKinematics, rows: dict[str, RigidKinematics]) -> None:
    """Print how far each export is from the model, and about how far from new measurements."""
    known = model.summary
    title = f"Distance from the model over its {len(model.configurations)} measured configurations, mm"
    table = Table(title=title, title_justify="left")
    table.add_column("export")
    for column in ("RMS", "max", "RMS, cross-validated", *(["about, for new measurements"] if known else [])):
        table.add_column(column, justify="right")
    for name, rigid in rows.items():
        left_out = rigid.validated.get(rigid.how, rigid.rms)
        numbers = [rigid.rms, rigid.largest, left_out]
        if known:
            numbers.append(hypot(left_out, known.leave_one_out_rms))
        table.add_row(plain(name), *(f"{1e3 * number:.4f}" for number in numbers))
    if known:
        table.add_row("(the model itself)", "", "", "", f"{1e3 * known.leave_one_out_rms:.4f}")
    out.print(table)
    if known:
        left = f"geometric calibration {1e3 * known.geometry_rms:.4f}, model {1e3 * known.diffeomorphic_rms:.4f}"
        say(f"RMS distance from the measurements of the fit, mm: {left}")


def _candidates(rigid: RigidKinematics) -> str:
    """What cross-validation said about each candidate."""
    said = ", ".join(f"{name} {1e3 * rms:.4f} mm" for name, rms in rigid.validated.items())
    return f" (cross-validated: {said})" if len(rigid.validated) > 1 else ""
