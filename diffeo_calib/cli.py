"""The command line: fit, evaluate, predict, demo.

Exit codes: 0 success; 1 the input or the model file cannot be used (one sentence says why);
2 wrong usage; 3 the fit stopped before it converged (the model is written); 130 interrupted by
Ctrl-C (the best model so far is written).
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from diffeo_calib.calibration.calibrate import CalibrationResult, calibrate
from diffeo_calib.errors import DiffeoCalibError, DiffeoCalibWarning, InputError, sentence
from diffeo_calib.evaluation import Evaluation, evaluate
from diffeo_calib.measurements import Measurements
from diffeo_calib.model import CalibratedKinematics
from diffeo_calib.plots import stages_figure
from diffeo_calib.robots.simulated_arm import SimulatedArm
from diffeo_calib.robots.urdf import load_urdf
from diffeo_calib.storage import load, save
from diffeo_calib.tables import read_joints, read_measurements, write_measurements, write_predictions

EXIT_ERROR, EXIT_UNCONVERGED, EXIT_INTERRUPTED = 1, 3, 130
DEMO_POSITION = ("measurement_x", "measurement_y", "measurement_z")

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Calibrate robot kinematics from measured positions.",
)
out, err = Console(), Console(stderr=True)


class Length(str, Enum):
    """Unit of positions and prismatic joints."""

    m = "m"
    mm = "mm"


class Angle(str, Enum):
    """Unit of revolute joints."""

    rad = "rad"
    deg = "deg"


CsvPath = Annotated[Path, typer.Argument(metavar="CSV", help="Table of measurements, one pose per row.")]
ModelPath = Annotated[Path, typer.Argument(metavar="MODEL", help="Model file written by `fit`.")]
Position = Annotated[
    list[str],
    typer.Option(
        "--position", metavar="X,Y,Z", help="The three position columns of a marker; repeat for more markers."
    ),
]
LengthOption = Annotated[
    Length, typer.Option("--length", help="Unit of positions (and prismatic joints) in the table.")
]
AngleOption = Annotated[Angle, typer.Option("--angle", help="Unit of revolute joints in the table.")]
Joints = Annotated[
    str | None,
    typer.Option(
        "--joints", metavar="A,B,...", help="Joint columns in the robot's order, if not named after its joints."
    ),
]
Sep = Annotated[str, typer.Option("--sep", help="Column separator of the table ('\\t' for a tab).")]
Decimal = Annotated[str, typer.Option("--decimal", help="Decimal character of the table.")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the split.")]


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
    holdout: Annotated[
        float,
        typer.Option(
            "--holdout", min=0.0, max=0.9, help="Fraction of the rows kept out of the fit to test it; 0 for none."
        ),
    ] = 0.3,
    seed: Seed = 0,
    duplicates: Annotated[
        str, typer.Option("--duplicates", help="Exactly repeated rows: error, keep or drop.")
    ] = "error",
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="IMAGE", help="Also draw the held-out errors.")
    ] = None,
) -> None:
    """Calibrate a robot, test it on held-out rows and write the model.

    The model is fitted to the rows that are not held out: its held-out errors are those in the table.
    """
    chain = load_urdf(robot, base, tip)
    columns = _names(joints) if joints else chain.joint_names
    data = read_measurements(
        csv,
        columns,
        _markers(position),
        length=length.value,
        angle=angle.value,
        sep=_separator(sep),
        decimal=decimal,
        duplicates=duplicates,
        kinds=chain.kinds,
    )
    data = Measurements(data.q, data.points, chain.joint_names, data.marker_names)
    train, test = data.split(1.0 - holdout, seed) if holdout else (data, None)
    with _progress() as progress:
        result = calibrate(chain, train, seed=seed, progress=progress)
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
) -> None:
    """Measure a model's position errors on a table of measurements."""
    kinematics = _load(model)
    data = read_measurements(
        csv,
        _names(joints) if joints else kinematics.robot.joint_names,
        _markers(position),
        length=length.value,
        angle=angle.value,
        sep=_separator(sep),
        decimal=decimal,
        duplicates="keep",
        kinds=kinematics.robot.kinds,
    )
    table = _table(f"Position errors in mm on {len(data)} rows", "model")
    _add_row(table, model.name, evaluate(kinematics, data))
    out.print(table)


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
) -> None:
    """Predict marker positions, with standard deviations, for a table of joint configurations."""
    kinematics = _load(model)
    q = read_joints(
        csv,
        _names(joints) if joints else kinematics.robot.joint_names,
        length=length.value,
        angle=angle.value,
        sep=_separator(sep),
        decimal=decimal,
        kinds=kinematics.robot.kinds,
    )
    mean, covariance = kinematics.predict(q)
    deviation = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    write_predictions(output, mean, deviation, length=length.value, sep=_separator(sep), decimal=decimal)
    out.print(f"{len(q)} predictions written to {output}")


@app.command("demo")
def demo_command(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Where to write everything.")] = Path(
        "demo_output"
    ),
    rows: Annotated[int, typer.Option("--rows", min=20, help="Number of simulated measurements.")] = 300,
    seed: Seed = 0,
) -> None:
    """Simulate an elastic six-axis arm and a laser tracker, then calibrate it exactly as a user would."""
    output.mkdir(parents=True, exist_ok=True)
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
    out.print(f"{rows} simulated measurements written to {csv}. Now running:\n", highlight=False)
    out.print("  diffeo-calib " + " \\\n      ".join(command) + "\n", highlight=False, soft_wrap=True)
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


def main() -> None:
    """Run the command line; every error on purpose becomes one sentence and an exit code."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", DiffeoCalibWarning)
        warnings.showwarning = _show_warning
        try:
            app()
        except DiffeoCalibError as error:
            err.print(f"[bold red]error:[/] {_plain(error)}", highlight=False, soft_wrap=True)
            sys.exit(EXIT_ERROR)
        except KeyboardInterrupt:
            err.print("[bold red]interrupted[/] before there was a model to keep")
            sys.exit(EXIT_INTERRUPTED)


def _report(
    result: CalibrationResult,
    train: Measurements,
    test: Measurements | None,
    output: Path,
    figure: Path | None,
    title: str,
) -> None:
    """Save the model, print the table of stages, and leave with the exit code of the fit."""
    save(result.model, output)
    sets = {"training": train} | ({"held out": test} if test is not None else {})
    table = _table("Position errors in mm by stage", "stage", "rows")
    for name, kinematics in result.stages.items():
        for label, data in sets.items():
            _add_row(table, name, evaluate(kinematics, data), f"{len(data)} {label}")
    out.print(table)
    fit = result.fit
    out.print(f"{result.status}", highlight=False, soft_wrap=True)
    out.print(
        f"coupling residual {fit.coupling_residual:.1e}, end residual {fit.end_residual:.1e}, "
        f"time-stepping error {1e3 * fit.step_error:.1e} mm with {fit.integrator.steps} step(s)",
        highlight=False,
        soft_wrap=True,
    )
    if figure is not None:
        shown = test if test is not None else train
        stages = {name: evaluate(kinematics, shown) for name, kinematics in result.stages.items()}
        stages_figure(
            stages, figure, f"{title}: errors on {len(shown)} {'held-out' if test is not None else 'training'} rows"
        )
        out.print(f"figure: {figure}", highlight=False, soft_wrap=True)
    out.print(f"model: {output}", highlight=False, soft_wrap=True)
    if result.interrupted:
        raise typer.Exit(EXIT_INTERRUPTED)
    if not fit.converged:
        raise typer.Exit(EXIT_UNCONVERGED)


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    for column in columns:
        table.add_column(column)
    for column in ("RMS", "median", "95 %", "max"):
        table.add_column(column, justify="right")
    return table


def _add_row(table: Table, name: str, errors: Evaluation, *labels: str) -> None:
    values = (errors.rms, errors.median, errors.p95, errors.max)
    table.add_row(name, *labels, *(f"{1e3 * value:.4f}" for value in values))


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar on standard error, one line per task."""
    columns = (
        TextColumn("{task.description:<18}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err, transient=True) as bar:
        tasks: dict[str, int] = {}

        def update(task: str, done: int, total: int) -> None:
            if task not in tasks:
                tasks[task] = bar.add_task(task, total=total)
            bar.update(tasks[task], completed=done, total=total)  # pyright: ignore[reportArgumentType]

        yield update


def _load(path: Path) -> CalibratedKinematics:
    model = load(path)
    if not isinstance(model, CalibratedKinematics):
        raise InputError(sentence(f"{path} is not a robot's model", fix="pass a file written by `diffeo-calib fit`"))
    return model


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _markers(position: list[str]) -> list[list[str]]:
    """Column triples of all markers."""
    triples = [_names(text) for text in position]
    for triple in triples:
        if len(triple) != 3:
            raise InputError(
                sentence(
                    "--position",
                    expected="three columns X,Y,Z",
                    got=",".join(triple),
                    fix="repeat --position for each marker",
                )
            )
    return triples


def _separator(text: str) -> str:
    return "\t" if text in ("\\t", "tab") else text


def _plain(error: object) -> str:
    """Text in which rich sees no markup."""
    return str(error).replace("[", "\\[")


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    err.print(f"[bold yellow]warning:[/] {_plain(message)}", highlight=False, soft_wrap=True)
