"""The command line: fit, evaluate, predict, export, demo.

Exit codes: 0 success; 1 the input or the model file cannot be used (one sentence says why);
2 wrong usage; 3 the fit stopped before it converged (the model is written); 130 interrupted by
Ctrl-C (the best model so far is written).

This module only declares the commands. Each imports its work when it runs, so that help, the version and shell
completion load neither torch nor SciPy and appear at once. Help is plain text for the same reason: rich takes longer
to load than everything else here.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from diffeo_calib.cli.interrupts import EXIT_INTERRUPTED, interrupts
from diffeo_calib.cli.options import (
    DEMO_ROWS,
    DH,
    Angle,
    AngleOption,
    Base,
    Controls,
    Convention,
    CsvOutput,
    CsvPath,
    Decimal,
    DemoRows,
    DemoSeed,
    DhConvention,
    DhOutput,
    Duplicates,
    ExportAngle,
    ExportLength,
    Figure,
    FolderOutput,
    FreeOption,
    Holdout,
    Joints,
    Length,
    LengthOption,
    Lever,
    ModelOutput,
    ModelPath,
    Note,
    OffsetsOutput,
    OtherRobot,
    Paper,
    Position,
    Register,
    RegisteredOutput,
    Robot,
    Rotation,
    RotationAngle,
    RotationStd,
    Seed,
    Sep,
    Std,
    TablesOutput,
    Tip,
    UrdfOutput,
    UrHash,
    UrOutput,
    WithTables,
)
from diffeo_calib.cli.places import check_figure, check_outputs, make_folder
from diffeo_calib.cli.streams import forgiving_streams
from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning, InputError

EXIT_ERROR = 1


class FlagsOff(TyperGroup):
    """A group whose flags are off by default rather than unset, which typer converts by a library that loads slowly."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The options of the program itself, all of which are flags: version, completion, help."""
        flags = super().get_params(ctx)
        for flag in flags:
            flag.default = False
        return flags


app = typer.Typer(
    cls=FlagsOff,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version  # noqa: PLC0415

        typer.echo(f"diffeo-calib {version('diffeo_calib')}")
        raise typer.Exit


@app.callback()
def common(
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Calibrate robot kinematics from measured positions or poses."""


@app.command("fit")
def fit_command(
    csv: CsvPath,
    robot: Robot,
    base: Base,
    tip: Tip,
    position: Position,
    length: LengthOption,
    angle: AngleOption,
    output: ModelOutput,
    joints: Joints = None,
    sep: Sep = ",",
    decimal: Decimal = ".",
    rotation: Rotation = None,
    convention: Convention = None,
    rotation_angle: RotationAngle = None,
    lever: Lever = None,
    std: Std = None,
    rotation_std: RotationStd = None,
    holdout: Holdout = 0.3,
    seed: Seed = 0,
    controls: Controls = None,
    duplicates: Duplicates = "error",
    figure: Figure = None,
    note: Note = "",
) -> None:
    """Calibrate a robot, test it on held-out rows and write the model.

    The model is fitted to the rows that are not held out: its held-out errors are those in the table.
    """
    check_outputs({"-o": output, "--figure": figure}, {"CSV": csv, "--robot": robot})
    check_figure(figure)
    from diffeo_calib.cli import tables  # noqa: PLC0415
    from diffeo_calib.cli.commands import fit  # noqa: PLC0415

    table = tables.table_format(length, angle, sep, decimal)
    table = tables.with_rotation(table, rotation, convention, rotation_angle, lever)
    table = tables.with_deviations(table, std, rotation_std)
    source = tables.MeasuredTable(csv, joints, position, table, duplicates)
    chain = fit.RobotFile(robot, base, tip)
    fit.run(chain, source, output, figure, holdout=holdout, seed=seed, controls=controls, note=note)


@app.command("evaluate")
def evaluate_command(
    model: ModelPath,
    csv: CsvPath,
    position: Position,
    length: LengthOption,
    angle: AngleOption,
    joints: Joints = None,
    sep: Sep = ",",
    decimal: Decimal = ".",
    rotation: Rotation = None,
    convention: Convention = None,
    rotation_angle: RotationAngle = None,
    lever: Lever = None,
    std: Std = None,
    rotation_std: RotationStd = None,
    register: Register = False,
    free: FreeOption = None,
    output: RegisteredOutput = None,
) -> None:
    """Measure the errors of a model on a table of measurements.

    --register first finds where the measuring device and the markers are now, and keeps everything else.
    """
    if not register and not (free is None and output is None):
        raise InputError.of("--free and -o belong to --register", fix="add --register, or leave them out")
    check_outputs({"-o": output}, {"MODEL": model, "CSV": csv})
    from diffeo_calib.cli import tables  # noqa: PLC0415
    from diffeo_calib.cli.commands import evaluate  # noqa: PLC0415

    table = tables.table_format(length, angle, sep, decimal)
    table = tables.with_rotation(table, rotation, convention, rotation_angle, lever)
    table = tables.with_deviations(table, std, rotation_std)
    source = tables.MeasuredTable(csv, joints, position, table)
    if register:
        evaluate.run_registered(model, source, "both" if free is None else free.value, output)
    else:
        evaluate.run(model, source)


@app.command("predict")
def predict_command(
    model: ModelPath,
    csv: CsvPath,
    angle: AngleOption,
    length: LengthOption,
    output: CsvOutput,
    joints: Joints = None,
    sep: Sep = ",",
    decimal: Decimal = ".",
    convention: Convention = None,
    rotation_angle: RotationAngle = None,
) -> None:
    """Predict positions or poses for a table of joint values.

    Writes the joints, the positions, and the standard deviations that a new measurement would have. For a model that
    was calibrated with poses it adds the rotation, by default as a rotation vector in the unit of --angle.
    """
    check_outputs({"-o": output}, {"MODEL": model, "CSV": csv})
    from diffeo_calib.cli import tables  # noqa: PLC0415
    from diffeo_calib.cli.commands import predict  # noqa: PLC0415

    table = tables.table_format(length, angle, sep, decimal)
    table = tables.with_rotation(table, None, convention, rotation_angle, None)
    predict.run(model, csv, joints, table, output)


@app.command("export")
def export_command(
    model: ModelPath,
    urdf: UrdfOutput = None,
    dh: DhOutput = None,
    dh_convention: DhConvention = DH.standard,
    ur_kinematics: UrOutput = None,
    ur_hash: UrHash = None,
    joint_offsets: OffsetsOutput = None,
    correction_tables: TablesOutput = None,
    with_tables: WithTables = False,
    robot: OtherRobot = None,
    length: ExportLength = Length.m,
    angle: ExportAngle = Angle.rad,
) -> None:
    """Write a model in the formats of other programs.

    Name at least one file. A table says how far each is from the model: rigid kinematics hold neither gravity sag nor
    transmission errors, correction tables hold transmission errors only.
    """
    outputs: dict[str, Path | None] = {
        "--urdf": urdf,
        "--dh": dh,
        "--ur-kinematics": ur_kinematics,
        "--joint-offsets": joint_offsets,
        "--correction-tables": correction_tables,
    }
    if not any(outputs.values()):
        raise typer.BadParameter(f"name at least one file to write: {', '.join(outputs)}")
    if with_tables and not (correction_tables and (urdf or dh or ur_kinematics)):
        raise typer.BadParameter("--with-tables needs --correction-tables, and --urdf, --dh or --ur-kinematics")
    if ur_hash is not None and ur_kinematics is None:
        raise typer.BadParameter("--ur-hash belongs to --ur-kinematics")
    check_outputs(outputs, {"MODEL": model} | ({} if robot is None else {"--robot": robot}))
    from diffeo_calib.cli.commands import export  # noqa: PLC0415

    formats = export.Formats(dh_convention.value, length.value, angle.value, ur_hash)
    export.run(model, outputs, formats, robot, with_tables=with_tables)


@app.command("demo")
def demo_command(
    output: FolderOutput = Path("demo_output"),
    rows: DemoRows = None,
    seed: DemoSeed = None,
    paper: Paper = False,
) -> None:
    """Simulate a robot and calibrate it as a user would.

    The robot is an elastic six-axis arm, measured by a laser tracker. --paper takes the arm of the paper instead.
    """
    if paper and not (rows is None and seed is None):
        what = "--rows and --seed belong to the simulated arm: section 5 of the paper has 256 points without noise"
        raise InputError.of(what, fix="leave them out, or leave --paper out")
    make_folder(output)
    from diffeo_calib.cli.commands import demo  # noqa: PLC0415

    if paper:
        demo.run_paper(output)
        return
    app(demo.simulate(output, rows=DEMO_ROWS if rows is None else rows, seed=0 if seed is None else seed))


def main() -> None:
    """Run the command line; every error of this package becomes one sentence and an exit code."""
    interrupts.install()
    with forgiving_streams(), warnings.catch_warnings():
        warnings.simplefilter("always", DiffeoCalibWarning)
        warnings.showwarning = _show_warning
        try:
            app()
        except DiffeoCalibError as error:
            from diffeo_calib.cli.console import show_error  # noqa: PLC0415

            show_error(error)
            sys.exit(EXIT_ERROR)
        except KeyboardInterrupt:
            sys.exit(EXIT_INTERRUPTED)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Takes the place of :func:`warnings.showwarning`."""
    from diffeo_calib.cli.console import show_warning  # noqa: PLC0415

    show_warning(message)
