"""Fuzzing of the command line: options with odd values, options that are missing, repeated or of another command.

Six of ten commands are sound: only options that fit them are added, repeated or moved, and they must succeed.

    python benchmarks/robustness/commands.py --count 300

Commands run in this process, in a folder of their own, on a small arm. The exit code must be 0, 1, 2, 3 or 130, no
traceback may be shown, an error must be one sentence, and a command that ends with 0 must have written its output.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import typer.main
from fuzzing import Work, run

import diffeo_calib as dc
from diffeo_calib.cli import main as cli
from diffeo_calib.common.errors import DiffeoCalibError, warn_user
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

Rng = np.random.Generator
ROWS, SOUND_SHARE = 14, 0.6
CODES = (0, 1, 2, 3, 130)
UNITS = ("--length", "mm", "--angle", "deg")
PLACES = ("--position", "x,y,z")
ROBOT = ("--robot", "arm.urdf", "--base", "base_link", "--tip", "flange")
COMMANDS = {
    "fit": ("fit", "table.csv", *ROBOT, *PLACES, *UNITS, "-o", "out"),
    "evaluate": ("evaluate", "model", "table.csv", *PLACES, *UNITS),
    "register": ("evaluate", "model", "table.csv", *PLACES, *UNITS, "--free", "both", "-o", "out"),
    "predict": ("predict", "model", "table.csv", *UNITS, "-o", "out"),
    "correct": ("correct", "model", "table.csv", *UNITS, "-o", "out"),
    "export": ("export", "model", "--urdf", "out"),
}
ODD_VALUES = (
    *("", " ", "0", "1", "-1", "3.5", "1e300", "-1e300", "nan", "inf", "99999999999999999999"),
    *("-99999999999999999999", "abc", "x,y,z", "x,y", "x,,z", "x,x,x", "a,b,c,d,e,f", "é", "\x1b[31m", "\udcff"),
    *(
        "x" * 3000,
        "--seed",
        "-",
        "@",
        "table.csv",
        "arm.urdf",
        "model",
        "nowhere/out",
        "/",
        ".",
        "/dev/null",
        "out.png",
    ),
    *(
        "out.c",
        "0,0,150",
        "0,0,1e200",
        "xyz",
        "XYZ",
        "rotvec",
        "quat_xyzw",
        "matrix",
        "m",
        "mm",
        "rad",
        "deg",
        ";",
        ",",
    ),
    *("\\t", "'", '"', "both", "first", "0.5", "0.99", "1e-9", "1e400", "12", "True", "%s", "{0}", "[red]", "[/]"),
    *("$HOME", "*", "~"),
)


JOINTS = "waist_joint,shoulder_joint,elbow_joint,forearm_roll_joint,wrist_bend_joint,wrist_roll_joint"
READING = (
    *(("--sep", ","), ("--decimal", "."), ("--joint-length", "m"), ("--joint-length", "mm"), ("--joints", JOINTS)),
    *(UNITS, ("--angle", "deg"), ("--length", "mm")),
)
SOUND = {
    "fit": (
        *(*READING, ROBOT, ("--report", "out.html"), ("--holdout", "0"), ("--holdout", "0.2")),
        *(("--seed", "1"), ("--seed", "4294967295"), ("--note", "é [red] %s"), ("--controls", "10")),
        *(("--duplicates", "keep"), ("--duplicates", "drop"), ("-o", "other"), ("-o", "model")),
    ),
    "evaluate": READING,
    "register": (*READING, ("--free", "both"), ("--free", "base"), ("--free", "marker"), ("-o", "other")),
    "predict": (*READING, ("-o", "other"), ("-o", "other.csv")),
    "correct": (
        *(*READING, ("--tool", "0,0,150"), ("--frame", "base"), ("--limit", "5")),
        *(("--tool", "0,0,150"), ("-o", "other")),
    ),
    "export": (
        *(("--urdf", "other"), ("--dh", "dh.csv"), ("--dh", "dh.csv", "--dh-convention", "craig"), ("--c", "out.c")),
        *(("--joint-offsets", "o.csv"), ("--correction-tables", "t.csv"), ("--robot", "arm.urdf"), ("--length", "m")),
        *(
            ("--correction-tables", "t.csv"),
            ("--c", "out.c", "--tool", "0,0,0.15"),
            ("--angle", "rad"),
        ),
        ("--c", "out.c", "--frame", "base"),
    ),
}
"""Options that can be added to a command, alone and together."""


@dataclass(frozen=True)
class Option:
    """An option of a command: its name, and whether it takes a value."""

    name: str
    value: bool


@cache
def options() -> dict[str, list[Option]]:
    """The real options of every command."""
    group: Any = typer.main.get_command(cli.app)
    return {
        name: [
            Option(text, not getattr(parameter, "is_flag", False))
            for parameter in command.params
            for text in parameter.opts
            if text.startswith("-") and text != "--help"
        ]
        for name, command in group.commands.items()
    }


@cache
def site() -> Path:
    """A folder with a robot, its table and a model; it lasts as long as the process."""
    folder = Path(tempfile.mkdtemp(prefix="commands"))
    arm = SimulatedArm(seed=1)
    data = dc.Measurements(*arm.measure(ROWS, seed=2), arm.nominal.joint_names)
    arm.write_urdf(folder / "arm.urdf")
    write_measurements(folder / "table.csv", data, TableFormat("mm", "deg"), position=("x", "y", "z"))
    dc.save(dc.calibrate(arm.nominal, data).model, folder / "model")
    return folder


@contextlib.contextmanager
def own_folder() -> Iterator[Path]:
    """A copy of the site as the current folder."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(site(), folder, dirs_exist_ok=True)
        os.chdir(folder)
        try:
            yield Path(folder)
        finally:
            os.chdir(before)


def executed(arguments: list[str]) -> tuple[object, str, str]:
    """Exit code, standard output and standard error of a command."""
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    before = signal.getsignal(signal.SIGINT)
    called = mock.patch.object(sys, "argv", ["diffeo-calib", *arguments])
    with called, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main()
        except SystemExit as end:
            code = 0 if end.code is None else end.code
        finally:
            signal.signal(signal.SIGINT, before)
    return code, out.getvalue(), err.getvalue()


# --- mutations ------------------------------------------------------------------------------------------------------


def _pick(rng: Rng, items: Any) -> Any:
    return items[int(rng.integers(len(items)))]


def mutated(seed: int) -> tuple[str, list[str], bool]:
    """The command of a seed, and whether it is sound: else one to three words or options are wrong."""
    rng = np.random.default_rng([seed, 3])
    kind = _pick(rng, sorted(COMMANDS))
    words = list(COMMANDS[kind])
    if rng.random() < SOUND_SHARE:
        added = [_pick(rng, SOUND[kind]) for _ in range(1 + int(rng.integers(3)))]
        front = rng.random() < 0.3  # options may stand before the arguments
        for option in added:
            words[1 if front else len(words) : 1 if front else len(words)] = option
        return kind, words, True
    for _ in range(1 + int(rng.integers(3))):
        how, place = int(rng.integers(8)), int(rng.integers(1, len(words)))
        if how == 0:
            del words[place]
        elif how == 1:
            words[place] = _pick(rng, ODD_VALUES)
        elif how == 2:
            words.insert(place, words[place])
        else:
            command = words[0] if words[0] in options() and how < 7 else _pick(rng, sorted(options()))
            option = _pick(rng, options()[command])
            words += [option.name, *([_pick(rng, ODD_VALUES)] if option.value else [])]
        if len(words) < 2:
            break
    return kind, words, False


def tried(words: list[str], *, sound: bool) -> str:
    """Run the command; what is wrong with how it ended, or nothing."""
    with own_folder() as folder:
        before = {path.name: path.read_bytes() for path in folder.iterdir()}
        code, out, err = executed(words)
        lines = [line for line in err.splitlines() if line.strip() and not line.startswith("warning: ")]
        errors = [line for line in lines if line.startswith(("error: ", "Error"))]
        changed = [name for name in before if (folder / name).read_bytes() != before[name]]
    said = f"{words}: code {code}, {err[-300:]!r}"
    if "Traceback" in out + err:
        raise RuntimeError(said)
    if code not in CODES:
        return f"another exit code: {said}"
    if code == 1 and not (len(errors) == 1 and len(lines) == 1):
        return f"not one sentence: {said}"
    if code == 2 and not errors:  # wrong usage
        return f"no error: {said}"
    if changed and code != 0:
        return f"an input was changed ({changed}): {said}"
    if code in (1, 2) and sound:
        return f"a sound command was refused: {said}"
    if code in (1, 2):
        raise DiffeoCalibError(errors[0] if code == 1 else "wrong usage.")
    if "warning: " in err:
        warn_user("the command warned.")
    return ""


def case(seed: int) -> tuple[str, Work]:
    """The command of a seed."""
    kind, words, sound = mutated(seed)
    return f"{kind}: {words[1:]!r}"[:400], lambda: tried(words, sound=sound)


if __name__ == "__main__":
    run("commands.py", case, __doc__, 300)
