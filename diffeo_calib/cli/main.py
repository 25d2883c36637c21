"""The command line: fit, evaluate, predict, demo.

Exit codes: 0 success; 1 the input or the model file cannot be used (one sentence says why);
2 wrong usage; 3 the fit stopped before it converged (the model is written); 130 interrupted by
Ctrl-C (the best model so far is written).
"""

from __future__ import annotations

import math
import sys
import warnings
from dataclasses import asdict
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from diffeo_calib.calibration.calibrate import CalibrationResult, calibrate
from diffeo_calib.cli.console import (
    EXIT_INTERRUPTED,
    Interrupts,
    add_errors,
    error_table,
    out,
    outlier_lines,
    parts_table,
    progress_bar,
    say,
    show_error,
    show_warning,
    told_interruption,
)
from diffeo_calib.cli.options import (
    Angle,
    AngleOption,
    Convention,
    CsvPath,
    Decimal,
    Joints,
    Layout,
    Length,
    LengthOption,
    Lever,
    ModelPath,
    Position,
    Rotation,
    RotationAngle,
    RotationStd,
    Seed,
    Sep,
    Std,
    check_apart,
    check_figure,
    check_places,
    position_columns,
    reading_options,
    separator,
    split_names,
)
from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning, InputError, sentence
from diffeo_calib.fitting.fit import fit
from diffeo_calib.interop.model_file import load, save
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import doubt, evaluate
from diffeo_calib.measurements.csv_files import read_joints, read_measurements, write_measurements, write_predictions
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.paper.algorithms import section_5
from diffeo_calib.paper.figures import TEST_ROWS, mean_error, paper_figures
from diffeo_calib.reports.figures import stages_figure
from diffeo_calib.robots import elastic_rr
from diffeo_calib.robots.chain import Chain
from diffeo_calib.robots.simulated_arm import SimulatedArm
from diffeo_calib.robots.urdf import load_urdf

EXIT_ERROR, EXIT_UNCONVERGED = 1, 3
SAME_CONFIGURATION = 1e-9
"""Largest difference, rad or m, of a row's joints from a training row's that may be rounding of the file."""
OUTSIDE = 0.25
"""Part of a joint's range in the fit by which a row may lie outside of it without a word."""
DEMO_ROWS = 300
DEMO_POSITION = ("measurement_x", "measurement_y", "measurement_z")

interrupts = Interrupts()
app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Calibrate robot kinematics from measured positions.",
)


@app.callback()
def common(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.", is_eager=True)] = False,
) -> None:
    """Calibrate robot kinematics from measured positions."""
    if version:
        say(f"diffeo-calib {installed_version('diffeo_calib')}")
        raise typer.Exit


@app.command("fit")
def fit_command(
    csv: CsvPath,
    robot: Annotated[Path, typer.Option("--robot", metavar="URDF", help="The robot's description.")],
    base: Annotated[str, typer.Option("--base", metavar="LINK", help="First link of the chain.")],
    tip: Annotated[
        str, typer.Option("--tip", metavar="LINK", help="Last link of the chain; the markers are fixed to it.")
    ],
    position: Position,
    length: LengthOption,
    angle: AngleOption,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MODEL", help="Model file to write.")],
    joints: Joints = None,
    sep: Sep = ",",
    decimal: Decimal = ".",
    rotation: Rotation = None,
    convention: Convention = None,
    rotation_angle: RotationAngle = None,
    lever: Lever = None,
    std: Std = None,
    rotation_std: RotationStd = None,
    holdout: Annotated[
        float,
        typer.Option(
            "--holdout", min=0.0, max=0.9, help="Fraction of the rows kept out of the fit to test it; 0 for none."
        ),
    ] = 0.3,
    seed: Seed = 0,
    controls: Annotated[
        int | None,
        typer.Option(
            "--controls", min=10, help="How many rows carry the deformation; by default all, or 200 of very many."
        ),
    ] = None,
    duplicates: Annotated[
        str, typer.Option("--duplicates", help="Exactly repeated rows: error, keep or drop.")
    ] = "error",
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="IMAGE", help="Also draw the errors (held-out rows, if any).")
    ] = None,
) -> None:
    """Calibrate a robot, test it on held-out rows and write the model.

    The model is fitted to the rows that are not held out: its held-out errors are those in the table.
    """
    check_places({"-o": output, "--figure": figure})
    check_figure(figure)
    check_apart({"-o": output, "--figure": figure}, {"CSV": csv, "--robot": robot})
    with told_interruption(), progress_bar() as progress:
        chain = load_urdf(robot, base, tip)
        layout = Layout.of(length, angle, sep, decimal)
        layout = layout.with_poses(rotation, convention, rotation_angle, lever).with_std(std, rotation_std)
        data = _read(csv, chain, joints, position, layout, duplicates)
        train, test = data.split(1.0 - holdout, seed) if holdout else (data, None)
        result = calibrate(
            chain,
            train,
            controls="auto" if controls is None else controls,
            seed=seed,
            progress=interrupts.watching(progress),
        )
    _report(result, train, test, output, figure, title=csv.name)


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
) -> None:
    """Measure a model's errors on a table of measurements."""
    kinematics = _load(model)
    layout = Layout.of(length, angle, sep, decimal)
    layout = layout.with_poses(rotation, convention, rotation_angle, lever).with_std(std, rotation_std)
    data = _read(csv, kinematics.robot, joints, position, layout, "keep")
    _warn_outside(kinematics, data.q)
    fitted = kinematics.configurations
    used = torch.tensor([bool(((fitted - q).abs() < SAME_CONFIGURATION).all(1).any()) for q in data.q])
    turned = kinematics.lever is not None
    table = error_table(f"Position errors of {model.name} in mm", "rows", angles=turned)
    errors = evaluate(kinematics, data)
    add_errors(table, errors, f"{len(data)} in all")
    for mask, label in ((used, "used in the fit"), (~used, "not used in the fit")):
        if used.any() and mask.any():
            add_errors(table, evaluate(kinematics, data.rows(mask)), f"{int(mask.sum())} {label}")
    out.print(table)
    doubtful = doubt(kinematics, data, errors)
    if doubtful is not None:
        warnings.warn(doubtful, DiffeoCalibWarning, stacklevel=1)


@app.command("predict")
def predict_command(
    model: ModelPath,
    csv: CsvPath,
    angle: AngleOption,
    length: LengthOption,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="CSV", help="Table of predictions to write.")],
    joints: Joints = None,
    sep: Sep = ",",
    decimal: Decimal = ".",
    convention: Convention = None,
    rotation_angle: RotationAngle = None,
) -> None:
    """Predict marker positions, or poses, for a table of joint configurations.

    Writes the joints, the positions, and the standard deviations that a new measurement would have. A model that was
    calibrated with poses adds the rotation, as a rotation vector in the unit of --angle unless told otherwise.
    """
    check_places({"-o": output})
    check_apart({"-o": output}, {"MODEL": model, "CSV": csv})
    kinematics = _load(model)
    chain = kinematics.robot
    names = split_names(joints) if joints else list(chain.joint_names)
    units: dict[str, Any] = {"length": length.value, "angle": angle.value, "sep": separator(sep), "decimal": decimal}
    q = read_joints(csv, names, kinds=chain.kinds, **units)
    units |= {"joints": names, "kinds": chain.kinds}
    back = ""
    _warn_outside(kinematics, q)
    if kinematics.lever is not None:
        unit = None if rotation_angle is None else rotation_angle.value
        _write_poses(kinematics, output, q, convention=convention or "rotvec", rotation_angle=unit, **units)
        back = reading_options(convention or "rotvec", unit or angle.value)
    elif convention or rotation_angle:
        what = "--convention and --rotation-angle say how orientations are written, but this model has none"
        raise InputError(sentence(what, fix="leave them out, or calibrate with measured poses"))
    else:
        mean, covariance = kinematics.predict(q)
        write_predictions(output, q, mean, _deviations(covariance), **units)
    what = "positions" if kinematics.lever is None else "poses"
    say(f"{len(q)} predictions written to {output}: joints, {what} and standard deviations of a new measurement")
    if back:
        say(f"`evaluate` and `fit` read these poses with {back}")


@app.command("demo")
def demo_command(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Where to write everything.")] = Path(
        "demo_output"
    ),
    rows: Annotated[
        int | None, typer.Option("--rows", min=20, help=f"Number of simulated measurements, {DEMO_ROWS} by default.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Of arm and noise, 0 by default.")] = None,
    paper: Annotated[
        bool, typer.Option("--paper", help="The elastic RR arm of the paper's section 5 instead, and its figures.")
    ] = False,
) -> None:
    """Simulate an elastic six-axis arm and a laser tracker, then calibrate it exactly as a user would."""
    if paper and not (rows is None and seed is None):
        what = "--rows and --seed belong to the simulated arm: section 5 of the paper has 256 points without noise"
        raise InputError(sentence(what, fix="leave them out, or leave --paper out"))
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"the folder {output} cannot be made ({error.strerror})"
        raise InputError(sentence(what, fix="name another folder")) from error
    if paper:
        _paper(output)
        return
    rows, seed = DEMO_ROWS if rows is None else rows, 0 if seed is None else seed
    arm = SimulatedArm(seed=seed)
    urdf, csv = output / "arm.urdf", output / "measurements.csv"
    arm.write_urdf(urdf)
    q, points = arm.measure(rows, seed=seed)
    data = Measurements(q, points, arm.nominal.joint_names)
    write_measurements(csv, data, length="mm", angle="deg", sep=";", decimal=",", position=DEMO_POSITION)
    command = [
        f"fit {csv} --robot {urdf} --base {arm.nominal.base} --tip {arm.nominal.tip}",
        f"--position {','.join(DEMO_POSITION)} --length mm --angle deg --sep ';' --decimal ,",
        f"-o {output / 'model.safetensors'} --figure {output / 'calibration.png'}",
    ]
    say(f"{rows} simulated measurements written to {csv}. Now running:\n")
    say("  diffeo-calib " + " \\\n      ".join(command) + "\n")
    fit_command(
        csv=csv,
        robot=urdf,
        base=arm.nominal.base,
        tip=arm.nominal.tip,
        position=[",".join(DEMO_POSITION)],
        length=Length.mm,
        angle=Angle.deg,
        output=output / "model.safetensors",
        sep=";",
        decimal=",",
        figure=output / "calibration.png",
    )


def _paper(folder: Path) -> None:
    """Fit the paper's test bed and draw its figures."""
    with told_interruption(), progress_bar() as progress:
        result = fit(section_5(), progress=interrupts.watching(progress))
    say(f"256 measurements of the elastic RR arm, sigma 0.01: energy (16) {result.energy:.6e}, {result.status}")
    say(
        f"coupling residual {result.coupling_residual:.1e}, end residual {result.end_residual:.1e}, "
        f"{result.seconds:.2f} s (the paper: 470 s on 12 cores)"
    )
    nominal, calibrated = mean_error(elastic_rr.nominal), mean_error(result.model)
    say(
        f"mean error in {TEST_ROWS} other configurations: nominal {nominal:.2e}, calibrated {calibrated:.2e}, "
        f"{math.log10(nominal / calibrated):.2f} orders of magnitude less"
    )
    for path in paper_figures(result.model, folder):
        say(f"figure: {path}")


def main() -> None:
    """Run the command line; every error on purpose becomes one sentence and an exit code."""
    interrupts.install()
    with warnings.catch_warnings():
        warnings.simplefilter("always", DiffeoCalibWarning)
        warnings.showwarning = show_warning
        try:
            app()
        except DiffeoCalibError as error:
            show_error(error)
            sys.exit(EXIT_ERROR)
        except KeyboardInterrupt:
            sys.exit(EXIT_INTERRUPTED)


def _report(
    result: CalibrationResult,
    train: Measurements,
    test: Measurements | None,
    output: Path,
    figure: Path | None,
    *,
    title: str,
) -> None:
    """Print the table of stages, write the model, and leave with the exit code of the fit."""
    _show(result, train, test)
    shown, which = (train, "training rows, no row was held out") if test is None else (test, "held-out rows")
    stages = {name: evaluate(kinematics, shown) for name, kinematics in result.stages.items()}
    if test is not None and stages["diffeomorphic"].rms >= stages["geometry"].rms:
        say("the deformation does not improve on geometry for the held-out rows: measure more poses")
    save(result.model, output)
    say(f"model: {output}")
    if figure is not None:
        stages_figure(stages, figure, f"{title}: errors on {len(shown)} {which}")
        say(f"figure: {figure}")
    if result.interrupted or interrupts.asked:
        raise typer.Exit(EXIT_INTERRUPTED)
    if not result.fit.converged:
        raise typer.Exit(EXIT_UNCONVERGED)


def _show(result: CalibrationResult, train: Measurements, test: Measurements | None) -> None:
    """Print errors by stage, what explains how much, rows that look wrong, and how the fit ended."""
    sets = {"training": train} | ({"held out": test} if test is not None else {})
    table = error_table("Position errors in mm by stage", "stage", "rows", angles=train.poses is not None)
    for name, kinematics in result.stages.items():
        for label, data in sets.items():
            add_errors(table, evaluate(kinematics, data), name, f"{len(data)} {label}")
    out.print(table)
    if test is None:
        alone = 1e3 * float(result.model.report["leave-one-out rms [m]"])
        told = f" (leave-one-out RMS {alone:.4f} mm)" * (train.poses is None)
        say(f"no row was held out: these are errors on rows that were fitted, those of new poses are larger{told}")
    out.print(parts_table(result.parts))
    for line in outlier_lines(result.outliers, len(train)):
        say(line)
    left_out, fitted = result.leave_one_out, result.fit
    if left_out.effective is not None:
        say(f"effective number of parameters: {left_out.effective:.0f} of {left_out.errors.numel()} coordinates")
    say(result.status)
    say(
        f"coupling residual {fitted.coupling_residual:.1e}, end residual {fitted.end_residual:.1e}, "
        f"time-stepping error {1e3 * fitted.step_error:.1e} mm with {fitted.integrator.intervals} step(s)"
    )


def _read(
    csv: Path, chain: Chain, joints: str | None, position: list[str], layout: Layout, duplicates: str
) -> Measurements:
    """Measurements of a robot, under the names of its own joints."""
    names = split_names(joints) if joints else chain.joint_names
    options = {"duplicates": duplicates, "kinds": chain.kinds, **asdict(layout)}
    data = read_measurements(csv, names, position_columns(position), **options)
    return data.with_joint_names(chain.joint_names)


def _write_poses(kinematics: CalibratedKinematics, output: Path, q: torch.Tensor, **options: Any) -> None:
    poses, covariance = kinematics.predict_poses(q)
    deviations = _deviations(covariance)
    position, turn = deviations[:, None, :3], deviations[:, 3:]
    write_predictions(output, q, poses[:, None, :3, 3], position, poses=poses, rotation_deviations=turn, **options)


def _deviations(covariance: torch.Tensor) -> torch.Tensor:
    """Standard deviations of covariances: (..., k, k) -> (..., k)."""
    return covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()


def _warn_outside(kinematics: CalibratedKinematics, q: torch.Tensor) -> None:
    """Warn of configurations outside the range of the joints in the fit: the errors there are not known."""
    fitted = kinematics.configurations
    low, high = fitted.amin(0), fitted.amax(0)
    margin = OUTSIDE * (high - low) + SAME_CONFIGURATION
    outside = (q < low - margin) | (q > high + margin)
    if bool(outside.any()):
        names = ", ".join(
            name for name, flag in zip(kinematics.robot.joint_names, outside.any(0), strict=True) if bool(flag)
        )
        what = f"{int(outside.any(1).sum())} of {len(q)} rows are outside the joint range of the fit ({names})"
        fix = "trust them less than their standard deviations say, or measure there too"
        warnings.warn(sentence(what, fix=fix), DiffeoCalibWarning, stacklevel=2)


def _load(path: Path) -> CalibratedKinematics:
    model = load(path)
    if not isinstance(model, CalibratedKinematics):
        raise InputError(sentence(f"{path} is not a robot's model", fix="pass a file written by `diffeo-calib fit`"))
    return model
