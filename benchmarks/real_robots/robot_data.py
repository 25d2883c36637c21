"""Measured robots in a folder: the data sets and the format of their files.

Every subfolder with a file `dataset.json` is a data set; so are `ipa_ur10` and `franka_fr3` as published, whose
descriptors are below. A descriptor is a JSON object; optional entries are marked (?):

    "robot"       {"urdf": "ur10.urdf", "base": "base_link", "tip": "flange"}, or
                  {"dh": [[a, alpha, d], ...], "convention": "standard"}: one row per joint in m and rad, with theta
                  as a fourth and "prismatic" as a fifth entry (?); "convention" is "standard" or "craig"
    "csv"         the table, one row per pose
    "joints"      its joint columns, in the robot's order (? the names of the URDF's joints)
    "position"    ["x", "y", "z"], or one such triple per marker
    "length"      "m" or "mm", of positions and of prismatic joints
    "angle"       "rad" or "deg", of revolute joints
    "sep"         the separator of cells (? ",")
    "decimal"     "." or "," (? ".")
    "duplicates"  "error", "keep" or "drop" rows that copy an earlier one exactly (? "error")
    "rotation"    (?) the measured orientation: {"columns": ["rx", "ry", "rz"], "convention": "XYZ", "angle": "deg"},
                  or nine columns of a row-major matrix: {"columns": [...], "convention": "matrix"}
    "source"      (?) origin and licence of the data; not read

Paths are relative to the data set's own folder. An unknown entry is an error, since it may be misspelt.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, RobotError

DESCRIPTOR = "dataset.json"
VARIABLE = "DIFFEO_CALIB_DATA"
ENTRIES = {"robot": dict, "csv": str, "position": list, "length": str, "angle": str}
OPTIONAL = {"joints": list, "sep": str, "decimal": str, "duplicates": str, "rotation": dict, "source": str}
ROTATION_ENTRIES = ("columns", "convention", "angle")

BUILT_IN: dict[str, dict[str, Any]] = {
    "ipa_ur10": {
        "robot": {"urdf": "ur10_robot.urdf", "base": "base_link", "tip": "ee_link"},
        "csv": "measurements_iso_cubes.csv",
        "position": ["measurement_x", "measurement_y", "measurement_z"],
        "length": "mm",
        "angle": "rad",
        "sep": ";",
        "decimal": ",",
        "rotation": {
            "columns": ["measurement_rx", "measurement_ry", "measurement_rz"],
            "convention": "XYZ",
            "angle": "deg",
        },
    },
    "franka_fr3": {
        "robot": {
            "dh": [
                [0, 0, 0.333],
                [0, -pi / 2, 0],
                [0, pi / 2, 0.316],
                [0.0825, pi / 2, 0],
                [-0.0825, -pi / 2, 0.384],
                [0, pi / 2, 0],
                [0.088, pi / 2, 0.107],
            ],
            "convention": "craig",
        },
        "csv": "franka_fr3_camera.csv",
        "joints": [f"q{joint}_rad" for joint in range(1, 8)],
        "position": ["cam_T03", "cam_T13", "cam_T23"],
        "length": "m",
        "angle": "rad",
        "rotation": {
            "columns": [f"cam_T{row}{column}" for row in range(3) for column in range(3)],
            "convention": "matrix",
        },
    },
}


@dataclass(frozen=True)
class RobotData:
    """A robot and its measurements."""

    name: str
    robot: dc.Chain
    measurements: dc.Measurements


def data_folder(given: Path | None) -> Path:
    """Return the folder of data sets: the given one, else DIFFEO_CALIB_DATA.

    Raises:
        InputError: neither, or not a folder.
    """
    named = given or Path(os.environ.get(VARIABLE) or "")
    if given is None and not os.environ.get(VARIABLE):
        fix = f"pass --data FOLDER or set {VARIABLE}; scripts/get_ur10_data.py fetches a public data set"
        raise InputError.of("no folder of measurements is named", fix=fix)
    if not named.is_dir():
        raise InputError.of(f"the folder of measurements '{named}'", expected="an existing folder")
    return named


def find(folder: Path, wanted: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
    """Return the checked descriptors of data sets in a folder by name: of all of them, or of the wanted ones.

    Raises:
        InputError: no data set, an unknown name, or a bad descriptor.
    """
    names = sorted(entry.name for entry in folder.iterdir() if _is_data_set(entry))
    missing = [name for name in wanted if name not in names]
    if missing or not names:
        what = f"data set '{missing[0]}'" if missing else "data sets"
        expected = f"subfolders of '{folder}' with a {DESCRIPTOR}, or {' or '.join(BUILT_IN)}"
        raise InputError.of(what, expected=expected, got=", ".join(names) or "none")
    return {name: descriptor(folder / name) for name in (wanted or names)}


def _is_data_set(entry: Path) -> bool:
    return entry.is_dir() and ((entry / DESCRIPTOR).is_file() or entry.name in BUILT_IN)


def descriptor(folder: Path) -> dict[str, Any]:
    """Return the checked descriptor of one data set: its file if there is one, else the built-in one.

    Raises:
        InputError: not JSON, an entry missing, unknown or of the wrong kind.
    """
    path = folder / DESCRIPTOR
    if not path.is_file():
        return BUILT_IN[folder.name]
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError.of(f"'{path}' cannot be read as JSON ({error})", fix="correct the file") from error
    check(path, found)
    return found


def check(path: Path, found: object) -> None:
    """Raise InputError unless a descriptor follows the format of the module's docstring."""
    if not isinstance(found, dict):
        raise InputError.of(f"'{path}'", expected="a JSON object", got=type(found).__name__)
    missing = [name for name in ENTRIES if name not in found]
    unknown = [name for name in found if name not in ENTRIES | OPTIONAL]
    if missing or unknown:
        expected = f"the entries {', '.join(ENTRIES)}, and perhaps {', '.join(OPTIONAL)}"
        got = ", ".join([*(f"no '{name}'" for name in missing), *(f"the unknown '{name}'" for name in unknown)])
        raise InputError.of(f"'{path}'", expected=expected, got=got, fix="correct the file")
    for name, kind in (ENTRIES | OPTIONAL).items():
        if name in found and not isinstance(found[name], kind):
            expected = {dict: "an object", list: "a list", str: "a text"}[kind]
            raise InputError.of(f"'{name}' in '{path}'", expected=expected, got=repr(found[name]))
    _check_robot(path, found)
    rotation = found.get("rotation")
    if rotation is not None and not {"columns", "convention"} <= set(rotation) <= set(ROTATION_ENTRIES):
        expected = "'columns', 'convention' and perhaps 'angle'"
        raise InputError.of(f"'rotation' in '{path}'", expected=expected, got=", ".join(rotation) or "nothing")


def _check_robot(path: Path, found: Mapping[str, Any]) -> None:
    robot = found["robot"]
    if set(robot) not in ({"urdf", "base", "tip"}, {"dh", "convention"}):
        expected = "'urdf', 'base' and 'tip', or 'dh' and 'convention'"
        raise InputError.of(f"'robot' in '{path}'", expected=expected, got=", ".join(robot) or "nothing")
    rows = robot.get("dh", [[]])
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        raise InputError.of(f"'dh' in '{path}'", expected="a list of rows [a, alpha, d]", got=repr(rows))
    if "dh" in robot and "joints" not in found:
        raise InputError.of(f"'joints' in '{path}'", expected="the joint columns: a DH table has no names")


def read(folder: Path, entries: Mapping[str, Any], *, poses: bool = False) -> RobotData:
    """Read one data set.

    Args:
        folder: the data set's folder; its name becomes the data set's name.
        entries: its descriptor.
        poses: whether to read orientations too, if the descriptor has them.

    Raises:
        RobotError: a robot that cannot be read, or another number of joint columns.
        MeasurementError: a table that cannot be read.
    """
    robot = _robot(folder, entries)
    joints = entries.get("joints", list(robot.joint_names))
    if len(joints) != robot.n:
        what, expected = f"'joints' of data set '{folder.name}'", f"{robot.n}, one column per joint of the robot"
        raise RobotError.of(what, expected=expected, got=f"{len(joints)} ({', '.join(map(str, joints))})")
    options = {name: entries[name] for name in ("length", "angle", "sep", "decimal", "duplicates") if name in entries}
    if poses and "rotation" in entries:
        names = {"columns": "rotation", "convention": "convention", "angle": "rotation_angle"}
        options |= {names[entry]: value for entry, value in entries["rotation"].items()}
    data = dc.read_measurements(folder / entries["csv"], joints, entries["position"], kinds=robot.kinds, **options)
    return RobotData(folder.name, robot, data.with_joint_names(robot.joint_names))


def _robot(folder: Path, entries: Mapping[str, Any]) -> dc.Chain:
    robot = entries["robot"]
    if "urdf" in robot:
        return dc.load_urdf(folder / robot["urdf"], base=robot["base"], tip=robot["tip"])
    return dc.from_dh(robot["dh"], robot["convention"], names=entries["joints"], name=folder.name)
