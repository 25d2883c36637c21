"""The command line in a test: through `main()` in this process, or as a real process; and a robot with its table."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import jsonschema
import pytest

import diffeo_calib as dc
from diffeo_calib.cli import main as cli
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.reports.results import SCHEMA
from diffeo_calib.robots.simulated_arm import SimulatedArm

PROGRAM = "import sys; sys.argv[0] = 'diffeo-calib'; from diffeo_calib.__main__ import main; main()"
POSITION = "mx,my,mz"
TABLE = ["--position", POSITION, "--length", "mm", "--angle", "deg", "--sep", ";", "--decimal", ","]
FORMAT = TableFormat("mm", "deg", ";", ",")
"""That of TABLE."""
NOTE = "arm 7 [left], spring check; serial 4711 é"
"""Of the fitted model of the site."""
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
"""Judges results for programs; the schema itself is judged once, in tests/cli/test_json_results.py."""
STAGES = ("nominal", "geometric", "calibrated")

FEW_CONFIGURATIONS = 100

UNDRAWN = f'<svg viewBox="0 0 1 1">{4 * "<path/>"}</svg>'
"""In place of the pictures of a page."""

Edit = Callable[[list[list[str]]], object]
"""Changes the cells of a table, the header first, in place or into a new list."""


def leave_undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages keep their sections, numbers and labels; their pictures, which take most of the time, are empty."""
    monkeypatch.setattr("diffeo_calib.reports.analysis.findings.CONFIGURATIONS", FEW_CONFIGURATIONS)
    monkeypatch.setattr("diffeo_calib.reports.html.document.Picture.svg", lambda _: UNDRAWN)


@dataclass(frozen=True)
class Outcome:
    """How a command ended and what it wrote."""

    code: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one error sentence; anything beside it but warnings is a failure."""
        assert "Traceback" not in self.out + self.err
        lines = [line for line in self.err.splitlines() if line.strip()]
        errors = [line for line in lines if not line.startswith("warning: ")]
        assert len(errors) == 1, self.err
        assert errors[0].startswith("error: "), self.err
        assert errors[0].endswith("."), self.err
        return errors[0]

    @property
    def warnings(self) -> list[str]:
        return [line for line in self.err.splitlines() if line.startswith("warning: ")]

    def numbers(self, *labels: str) -> list[float]:
        """RMS, median, 95 % and maximum (of orientations, if there are any) in the table row that holds all labels."""
        lines = [line for line in self.out.splitlines() if "│" in line and all(label in line for label in labels)]
        rows = [line.split("│") for line in lines]
        assert len(rows) == 1, self.out
        numbers = [float(cell) for cell in rows[0][1:-1] if cell.strip().replace(".", "", 1).isdigit()]
        return numbers[-5:-1] if "expected RMS" in self.out else numbers[-4:]


class Command:
    """`diffeo-calib` in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        self.capsys, self.monkeypatch = capsys, monkeypatch

    def __call__(self, *arguments: object) -> Outcome:
        self.capsys.readouterr()
        before = signal.getsignal(signal.SIGINT)
        with self.monkeypatch.context() as patch:
            patch.setattr(sys, "argv", ["diffeo-calib", *map(str, arguments)])
            patch.setenv("COLUMNS", "120")
            code: object = 0
            try:
                cli.main()
            except SystemExit as exit_:
                code = exit_.code
            finally:
                signal.signal(signal.SIGINT, before)  # main() takes Ctrl-C over
        captured = self.capsys.readouterr()
        return Outcome(int(str(code or 0)), captured.out, captured.err)

    def failed(self, *arguments: object) -> str:
        """The one error sentence of a command that is refused."""
        done = self(*arguments)
        assert done.code == 1, done.out
        return done.error

    def ran(self, *arguments: object, silent: bool = False) -> Outcome:
        """Of a command that must succeed, ``silent``: and write nothing to its standard error."""
        done = self(*arguments)
        assert done.code == 0, done.err
        assert not silent or not done.err.strip(), done.err
        return done


def environment() -> dict[str, str]:
    """The environment of this process, with the package importable and room for the tables."""
    paths = os.pathsep.join([str(Path(dc.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": paths, "COLUMNS": "120", "PYTHONIOENCODING": "utf-8"}


def run_process(
    *arguments: object,
    program: Sequence[str] = ("-c", PROGRAM),
    cwd: Path | None = None,
    variables: Mapping[str, str] = MappingProxyType({}),
) -> Outcome:
    """`diffeo-calib` in a process of its own, in another folder or with more environment variables."""
    command, env = [sys.executable, *program, *map(str, arguments)], environment() | dict(variables)
    done = subprocess.run(command, capture_output=True, cwd=cwd, env=env, timeout=300, check=False, encoding="utf-8")
    return Outcome(done.returncode, done.stdout, done.stderr)


@dataclass(frozen=True)
class Site:
    """A folder with a robot and a table of its measurements, as a user has them."""

    folder: Path
    arm: SimulatedArm
    data: dc.Measurements

    @property
    def urdf(self) -> Path:
        return self.folder / "arm.urdf"

    @property
    def csv(self) -> Path:
        return self.folder / "measured.csv"

    def robot(self, tip: str = "flange") -> list[object]:
        return ["--robot", self.urdf, "--base", "base_link", "--tip", tip]

    def fit(self, csv: Path, output: Path, *more: object) -> list[object]:
        """Arguments of `fit` on a table in mm and deg with `;` and decimal commas; later options win."""
        return ["fit", csv, *self.robot(), *TABLE, "-o", output, *more]


def make_site(folder: Path, rows: int, markers: int = 1) -> Site:
    arm = SimulatedArm(seed=1, markers=markers)
    data = dc.Measurements(*arm.measure(rows, seed=2), arm.nominal.joint_names)
    site = Site(folder, arm, data)
    arm.write_urdf(site.urdf)
    triples = [POSITION.split(",")] if markers == 1 else [[f"{c}{k}" for c in ("x", "y", "z")] for k in range(markers)]
    write_measurements(site.csv, data, FORMAT, position=triples)
    return site


def edited(site: Site, path: Path, edit: Edit) -> Path:
    """A copy of the table after an edit of its cells."""
    cells = [line.split(";") for line in site.csv.read_text().splitlines()]
    changed = edit(cells)
    rows = changed if isinstance(changed, list) else cells
    path.write_text("".join(";".join(row) + "\n" for row in rows))
    return path


def set_cell(row: int, column: int, text: str) -> Edit:
    return lambda cells: cells[row].__setitem__(column, text)


def rows_of(*picked: int) -> Edit:
    return lambda cells: [cells[row] for row in picked]
