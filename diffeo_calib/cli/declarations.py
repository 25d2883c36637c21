"""The commands, as the command line declares them. Each imports its work when it runs.

Help, the version and shell completion therefore load neither torch nor SciPy and appear at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffeo_calib.cli import options
from diffeo_calib.cli.app import app, command
from diffeo_calib.cli.record import check_outputs, make_folder
from diffeo_calib.common.errors import InputError


@command("fit")
def fit_command(
    csv: options.CsvPath,
    robot: options.Robot,
    units: options.Units,
    output: options.ModelOutput,
    rows: options.Rows,
    given: options.FitOptions,
    duplicates: Annotated[
        str, typer.Option("--duplicates", help="Exactly repeated rows: error, keep or drop.")
    ] = "error",
    _jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            metavar="N",
            help="With several campaign files: how many run at a time; the exit code counts those that failed.",
        ),
    ] = None,
) -> None:
    """Calibrate a robot, test it on held-out rows, save the model.

    Rows may hold anything that was measured: positions, poses, a ball in sockets, readings of devices. The model is
    fitted to the rows that are not held out: its held-out errors are those in the table.

    A campaign file (`diffeo-calib fit campaign.toml`, see `init`) may take the place of CSV: it can hold all options,
    the required ones too; those that are typed as well win.
    """
    outputs = {"-o": output, "--figure": given.figure, "--report": given.report}
    others = given.scales_of or []
    check_outputs(outputs, {"CSV": csv, "--robot": robot.robot} | {f"--scales-of {other}": other for other in others})
    from diffeo_calib.cli.commands import fit  # noqa: PLC0415
    from diffeo_calib.cli.tables import measured_table  # noqa: PLC0415

    fit.run(robot, measured_table(csv, rows, units, duplicates), output, given)


@command("campaign")
def campaign_command(
    csv: options.CsvPath,
    robot: options.Robot,
    units: options.Units,
    rows: options.Rows,
    given: options.LiveOptions,
) -> None:
    """Judge rows while they are measured.

    Follows a table that another program appends to: every row gets a verdict, the expected error of the robot and the
    best poses to measure next. A journal beside the table keeps what was decided: after a crash the same command goes
    on where it stopped. Ends with exit code 0 when --target is reached, 4 if the rows end before.

    A campaign file (`diffeo-calib campaign campaign.toml`, see `init`) may take the place of CSV: it can hold all
    options, the required ones too; those that are typed as well win.
    """
    bag = {} if given.bag is None else {"--bag": given.bag}
    check_outputs({"--accepted": given.accepted}, {"CSV": csv, "--robot": robot.robot, **bag}, may_come="CSV")
    if (given.bag is None) != (given.seen is None):
        raise InputError.of("--bag and --seen belong together", fix="name both, or none")
    if given.bag is not None and (given.once or given.stdin):
        raise InputError.of("--once and --stdin beside --bag, whose end is that of the campaign", fix="leave them out")
    from diffeo_calib.cli.commands import campaign  # noqa: PLC0415
    from diffeo_calib.cli.tables import measured_table  # noqa: PLC0415

    campaign.run(robot, measured_table(csv, rows, units), given)


@command("record")
def record_command(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help="Folder of a ROS 2 bag.")],
    seen: Annotated[
        str,
        typer.Option(
            "--seen", metavar="TOPIC", help="Stamped points, poses or transforms that a device measured; or images."
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="CSV", help="Table to write.")],
    joints: Annotated[str, typer.Option("--joints", metavar="TOPIC", help="Joint states.")] = "/joint_states",
    still: Annotated[float, typer.Option("--still", min=1e-9, help="Largest motion of a joint at a stop.")] = 1e-3,
    shortest: Annotated[float, typer.Option("--shortest", min=0.01, help="Shortest stop in seconds.")] = 0.5,
    offset: Annotated[
        float | None,
        typer.Option(
            "--offset",
            help="Seconds to add to the times of --seen; by default estimated from all motions, 0 for images.",
        ),
    ] = None,
) -> None:
    """Turn a ROS 2 bag into a table, one row for each stop.

    A stop lasts as long as joints and measured places stand still; a row is the mean over it, in m and rad, with the
    standard deviations of what was seen (std_x, ...), its time and the number of readings. The clocks of both may
    differ. Needs the extra `ros`.

    Of images, the one nearest to the middle of each stop is written beside the table, which then has its name and the
    joint values for `images`.
    """
    check_outputs({"-o": output}, {})
    from diffeo_calib.cli.commands import record  # noqa: PLC0415

    record.run(bag, (joints, seen), output, record.StopLimits(joints=still, shortest=shortest), offset)


@command("evaluate")
def evaluate_command(
    model: options.ModelPath,
    csv: options.CsvPath,
    units: options.StoredUnits,
    rows: options.Rows,
    given: options.EvaluateOptions,
) -> None:
    """Measure the errors of a model on a table of measurements.

    The table is read as that of the model's fit, unless options say otherwise. --register first finds where the
    measuring device and the markers are now, and keeps everything else.
    """
    if not given.register and not (given.free is None and given.output is None):
        raise InputError.of("--free and -o belong to --register", fix="add --register, or leave them out")
    if given.register and not (given.fail_above is None and given.residuals is None):
        fix = "write the registered model with -o, and evaluate that"
        raise InputError.of("--fail-above and --residuals judge a model where it was fitted", fix=fix)
    check_outputs({"-o": given.output, "--residuals": given.residuals}, {"MODEL": model, "CSV": csv})
    from diffeo_calib.cli.commands import evaluate  # noqa: PLC0415

    evaluate.run(model, options.TableOptions(csv, rows, units), given)


@command("init")
def init_command(
    csv: options.CsvPath,
    urdf: Annotated[Path, typer.Argument(metavar="URDF", help="The robot's description.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="TOML", help="Campaign file to write.")] = Path(
        "campaign.toml"
    ),
    force: Annotated[bool, typer.Option("--force", help="Replace a campaign file that was edited.")] = False,
) -> None:
    """Propose the options of `fit` for a table and a URDF.

    Looks at names, numbers and plausible units, and writes a campaign file with a reason for every line. Check it, then
    run `diffeo-calib fit campaign.toml`.
    """
    check_outputs({"-o": output}, {"CSV": csv, "URDF": urdf})
    from diffeo_calib.cli.commands import init  # noqa: PLC0415

    init.run(csv, urdf, output, force=force)


@command("images")
def images_command(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER", help="Folder of the images, or one of each camera.")
    ],
    joints: Annotated[
        Path,
        typer.Argument(
            metavar="JOINTS",
            help="Table of joint values, with a column of file names unless rows are in their order.",
        ),
    ],
    given: options.BoardImages,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="CSV", help="Table of corners to write.")],
) -> None:
    """Find a printed board in a folder of images.

    Writes a line for each corner, and beside the table a file .yaml of the camera, for `fit --reading corners=FILE`.
    Several fixed cameras that see the same board: a folder and a file for each, named after it. Images that do not show
    the board are named with the reason and left out.
    """
    inputs = {"JOINTS": joints} | {f"FOLDER {folder}": folder for folder in folders}
    check_outputs({"-o": output, "--overview": given.overview}, inputs)
    from diffeo_calib.cli.commands import images  # noqa: PLC0415

    images.run(folders, joints, given, output)


@command("predict")
def predict_command(
    model: options.ModelPath,
    csv: options.CsvPath,
    units: options.StoredUnits,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="CSV", help="Table of predictions to write.")],
    convention: options.Convention = None,
    rotation_angle: options.RotationAngle = None,
    payload: options.PayloadColumn = None,
) -> None:
    """Predict positions or poses for a table of joint values.

    Writes the joints, the positions, and the standard deviations that a new measurement would have. For a model that
    was calibrated with poses it adds the rotation, by default as a rotation vector in the unit of --angle.
    """
    check_outputs({"-o": output}, {"MODEL": model, "CSV": csv})
    from diffeo_calib.cli.commands import predict  # noqa: PLC0415

    rows = options.Rows(convention=convention, rotation_angle=rotation_angle, payload=payload)
    predict.run(model, options.TableOptions(csv, rows, units), output)


@command("correct")
def correct_command(
    model: options.ModelPath,
    program: Annotated[
        Path,
        typer.Argument(metavar="PROGRAM", help="Table with a header, one command per row; other columns are kept."),
    ],
    units: options.StoredUnits,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="CSV", help="Corrected program to write.")],
    given: options.Correction,
) -> None:
    """Correct a program, so that the robot goes where it is told.

    The target of a row is the pose in which the nominal robot holds the tool at the row's joint values. With
    --position (and --rotation) it is read from the table, and the joint values are where the search starts.

    Writes the program with corrected joint values, and adds the pose (command_x, ...) of the tool in the URDF's base
    link, for a controller that does its own nominal inverse kinematics, the status of each row, its miss and how well
    the model knows the tool there (std_mm). Rows that cannot reach their targets get
    the nearest command that is allowed, and are listed; the exit code is 0 then, too. Joint cells stay empty where no
    command is allowed.

    With several tips the added columns carry their names (command_left_x, ...), and a tip whose target cells are empty
    may be anywhere in that row.
    """
    check_outputs({"-o": output}, {"MODEL": model, "PROGRAM": program})
    from diffeo_calib.cli.commands import correct  # noqa: PLC0415

    correct.run(model, program, units, given, output)


@command("export")
def export_command(
    model: options.ModelPath,
    given: options.Export,
) -> None:
    """Write a model in the formats of other programs.

    Name at least one file. A table says how far each is from the model: rigid kinematics hold neither gravity sag nor
    transmission errors, correction tables hold transmission errors only. Programs (--c, --torch, --onnx) hold the whole
    model.
    """
    outputs = given.outputs
    wanted = {option for option, target in outputs.items() if target is not None}
    if not wanted:
        raise typer.BadParameter(f"name at least one file to write: {', '.join(outputs)}")
    if given.with_tables and not ("--correction-tables" in wanted and wanted & {"--urdf", "--dh", "--ur-kinematics"}):
        raise typer.BadParameter("--with-tables needs --correction-tables, and --urdf, --dh or --ur-kinematics")
    if given.ur_hash is not None and "--ur-kinematics" not in wanted:
        raise typer.BadParameter("--ur-hash belongs to --ur-kinematics")
    if given.tip and not wanted & {"--c", "--dh"}:
        raise typer.BadParameter("--tip belongs to --c and --dh: the other files hold all tips")
    if (given.tool or given.frame) and not wanted & {"--c", "--torch", "--onnx"}:
        raise typer.BadParameter("--tool and --frame belong to --c, --torch and --onnx")
    header = {"--c (its header)": None if given.c is None else given.c.with_suffix(".h")}
    files = {name: path for name, path in outputs.items() if name != "--camera"}
    check_outputs(files | header, {"MODEL": model} | ({} if given.robot is None else {"--robot": given.robot}))
    from diffeo_calib.cli.commands import export  # noqa: PLC0415

    export.run(model, given)


@command("plan")
def plan_command(
    count: Annotated[int, typer.Option("-n", "--count", min=1, help="Number of poses to plan.")],
    units: options.StoredUnits,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="CSV", help="Table of poses to write: the joints, and a rank.")
    ],
    cell: options.Candidates,
    given: options.Planned,
    model: Annotated[
        Path | None,
        typer.Argument(metavar="MODEL", help="Model file written by `fit`, to plan the next poses; or name a --robot."),
    ] = None,
) -> None:
    """Plan which poses to measure, and say how many are needed.

    With --robot the first poses of a calibration, with a MODEL the next ones, and with --free those to measure again
    later. Lengths are in the unit of --length, angles in that of --angle; tables have the columns that `fit` reads.
    """
    inputs = {"MODEL": model, "--robot": given.robot, "--candidates": cell.candidates}
    inputs |= {"--target-poses": given.target_poses, "--measured": given.measured}
    check_outputs({"-o": output}, {name: path for name, path in inputs.items() if path is not None})
    _check_belonging(model, given)
    _check_draw(cell)
    from diffeo_calib.cli.commands import plan  # noqa: PLC0415

    plan.run(model, given, cell, units, count=count, output=output)


def _check_belonging(model: Path | None, given: options.Planned) -> None:
    """Either a model, or a robot with its links."""
    links = {"--robot": given.robot, "--base": given.base, "--tip": given.tip, "--marker": given.marker}
    named = [name for name, value in links.items() if value is not None]
    if model is not None and named:
        fix = "leave them out: the model knows its robot and its markers"
        raise InputError.of(f"{', '.join(named)} beside a MODEL", fix=fix)
    if model is None:
        missing = [name for name in ("--robot", "--base", "--tip") if links[name] is None]
        if missing:
            expected = "a MODEL, or --robot with --base and --tip"
            raise InputError.of("what to plan for", expected=expected, got=f"no {', '.join(missing)}")
        if given.payload_mass is not None:
            raise InputError.of(
                "--payload-mass without a MODEL", fix="leave it out: no sag under a payload is known yet"
            )
        if given.free is not None:
            raise InputError.of("--free without a MODEL", fix="name the model that was fitted before, or leave it out")


def _check_draw(cell: options.Candidates) -> None:
    """Options of random configurations mean nothing beside a table of candidates."""
    drawing = {"draw": cell.draw, "range": cell.limits, "tracker": cell.tracker, "floor": cell.floor}
    drawing |= {"column": cell.column, "collisions": cell.collisions or None}
    given = [f"--{name}" for name, value in drawing.items() if value is not None]
    if cell.candidates is not None and given:
        what = f"{', '.join(given)} beside --candidates: these options are about random configurations"
        raise InputError.of(what, fix="leave them out, or leave --candidates out")


@command("recalibrate")
def recalibrate_command(
    old: options.OldModel,
    csv: options.CsvPath,
    units: options.StoredUnits,
    output: options.ModelOutput,
    rows: options.Rows,
    marker: options.Marker = "evidence",
    drift: Annotated[
        options.Drift,
        typer.Option("--drift", help="tested: what a test names may have changed; none: device and markers only."),
    ] = "tested",
    seed: options.TestSeed = 0,
    note: options.Note = "",
) -> None:
    """Calibrate a robot anew, starting from an old model.

    The measuring device may stand anywhere. Twenty rows do what about a hundred do without the old model. The table is
    read as that of the old fit, unless options say otherwise. Says where device and markers are now and what has
    changed in the robot, offsets with signs as `compare` states them, and writes a model that knows old rows and new
    ones.
    """
    check_outputs({"-o": output}, {"OLD": old, "CSV": csv})
    from diffeo_calib.cli.commands import recalibrate  # noqa: PLC0415

    recalibrate.run(
        old, options.TableOptions(csv, rows, units), output, marker=marker, drift=drift, seed=seed, note=note
    )


@command("compare")
def compare_command(
    old: options.OldModel,
    other: Annotated[
        Path,
        typer.Argument(metavar="OTHER", help="Table of new measurements, or another model file of the same robot."),
    ],
    units: options.StoredUnits,
    rows: options.Rows,
    marker: options.Marker = "evidence",
    level: Annotated[
        float,
        typer.Option(
            "--level", min=0.001, max=0.2, help="Probability that anything is named although nothing changed."
        ),
    ] = 0.01,
    seed: options.TestSeed = 0,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="IMAGE", help="With a model: draw where the two differ.")
    ] = None,
) -> None:
    """Say what has changed since a calibration.

    With a table: a test for every joint, the load and the geometry. It is read as that of the old fit, unless options
    say otherwise. With a model: how far the two differ over the joint ranges that both know, beside what their
    uncertainties explain. An offset is added to what the joint reads: after a change by +0.5 mrad the joint stands
    0.5 mrad farther in its positive direction than the old model has it at the same reading. The exit code is 0 whether
    or not something has changed: with --json, programs read `changes` and `rows_can_tell`.
    """
    check_outputs({"--figure": figure}, {"OLD": old, "OTHER": other})
    from diffeo_calib.cli.commands import compare  # noqa: PLC0415

    if compare.is_model(other):
        if rows.named or units.length or units.angle:
            fix = "leave out the options of tables, or name a table"
            raise InputError.of(f"{other} is a model, beside options of a table", fix=fix)
        compare.run_models(old, other, seed, figure)
        return
    if figure is not None:
        raise InputError.of("--figure beside a table", expected="another model", fix="leave it out")
    compare.run(old, options.TableOptions(other, rows, units), marker, level, seed)


@command("report")
def report_command(
    model: options.ModelPath,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="HTML", help="Page to write.")],
    units: options.StoredUnits,
    rows: options.Rows,
    page: options.Page,
) -> None:
    """Write a report about a model, for a browser or a printer.

    One HTML file: how good the model is, where, why, whether it can be trusted, and what to do next. Rows of --data
    that were used in the fit are left out; the table is read as that of the fit, unless options say otherwise.
    """
    check_outputs({"-o": output}, {"MODEL": model} | ({} if page.data is None else {"--data": page.data}))
    from diffeo_calib.cli.commands import report  # noqa: PLC0415

    if page.data is None and (rows.named or units.length or units.angle or page.against):
        what = "--position, --socket, --reading, --length, --angle and --against belong to a table"
        raise InputError.of(what, fix="name the table with --data, or leave them out")
    report.run(model, output, None if page.data is None else options.TableOptions(page.data, rows, units), page)


@command("demo")
def demo_command(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder to write everything to.")
    ] = Path("demo_output"),
    rows: Annotated[int, typer.Option("--rows", min=20, help="Number of simulated measurements.")] = 300,
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=options.LARGEST_SEED, help="Seed of the arm and the noise.")
    ] = 0,
) -> None:
    """Simulate a robot and calibrate it as a user would.

    The robot is an elastic six-axis arm, measured by a laser tracker.
    """
    make_folder(output)
    from diffeo_calib.cli.commands import demo  # noqa: PLC0415

    app(demo.simulate(output, rows, seed))
