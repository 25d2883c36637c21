"""Options of the command line: their types and help, and what they mean together."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from diffeo_calib.common.errors import InputError, sentence
from diffeo_calib.measurements.csv_columns import UNITS_PER_METRE, Orientation
from diffeo_calib.measurements.table import LEVER
from diffeo_calib.reports.figures import FIGURES


class Length(str, Enum):
    """Unit of positions and prismatic joints."""

    m = "m"
    mm = "mm"


class Angle(str, Enum):
    """Unit of revolute joints."""

    rad = "rad"
    deg = "deg"


CsvPath = Annotated[Path, typer.Argument(metavar="CSV", help="Table with a header, one configuration per row.")]
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
Rotation = Annotated[
    str | None,
    typer.Option(
        "--rotation", metavar="A,B,...", help="Rotation columns, if poses were measured: 3, 4 or 9 by --convention."
    ),
]
Convention = Annotated[
    str | None,
    typer.Option(
        "--convention",
        help="How rotations are written: rotvec, quat_xyzw, quat_wxyz, matrix, "
        "or Euler angles about fixed (xyz) or turned axes (XYZ), in any order.",
    ),
]
RotationAngle = Annotated[
    Angle | None, typer.Option("--rotation-angle", help="Unit of Euler angles, rotation vectors and --rotation-std.")
]
Lever = Annotated[
    float | None,
    typer.Option(
        "--lever",
        help="Distance of the three points that stand for a pose from its origin, in the unit of --length: it weighs "
        "orientation against position. 0.1 m by default.",
    ),
]
Std = Annotated[
    str | None,
    typer.Option(
        "--std",
        metavar="A,B,...",
        help="Columns with standard deviations of the positions: one for all, one per marker or three per marker.",
    ),
]
RotationStd = Annotated[
    str | None,
    typer.Option(
        "--rotation-std",
        metavar="A,B,C",
        help="Columns with standard deviations of the rotation about the measuring frame's axes.",
    ),
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of the split.")]


@dataclass(frozen=True)
class Layout:
    """How a table is written, in the words of :func:`read_measurements`: units, separator, decimal mark, columns."""

    length: str
    angle: str
    sep: str
    decimal: str
    rotation: list[str] | None = None
    convention: str | None = None
    rotation_angle: str | None = None
    lever: float = LEVER
    std: list[str] | None = None
    rotation_std: list[str] | None = None

    @classmethod
    def of(cls, length: Length, angle: Angle, sep: str, decimal: str) -> Layout:
        """From the options that every table needs."""
        return cls(length.value, angle.value, separator(sep), decimal)

    def with_poses(
        self, rotation: str | None, convention: str | None, angle: Angle | None, lever: float | None
    ) -> Layout:
        """The same with columns of a rotation; the lever is in the unit of length."""
        if lever is not None and rotation is None:
            fix = "name the columns of the rotation too, or leave it out"
            raise InputError(sentence("--lever without --rotation", fix=fix))
        metres = LEVER if lever is None else lever / UNITS_PER_METRE[self.length]
        columns, unit = _if_given(rotation), None if angle is None else angle.value
        return replace(self, rotation=columns, convention=convention, rotation_angle=unit, lever=metres)

    def with_std(self, std: str | None, rotation_std: str | None) -> Layout:
        """The same with columns of standard deviations."""
        return replace(self, std=_if_given(std), rotation_std=_if_given(rotation_std))


def check_places(outputs: dict[str, Path | None]) -> None:
    """Refuse places that cannot be written before the work starts, not after it."""
    for option, path in outputs.items():
        if path is None:
            continue
        if path.is_dir():
            raise InputError(
                sentence(f"{option} {path} is a folder", expected="the name of a file", fix="add a name to it")
            )
        if not path.parent.is_dir():
            fix = "make it first, or name a file in another folder"
            raise InputError(sentence(f"{option} {path} cannot be written, there is no folder {path.parent}", fix=fix))
        needed = [path] if path.exists() and not path.is_file() else [path.parent, *[path] * path.exists()]
        if not all(os.access(place, os.W_OK) for place in needed):
            what = f"{option} {path} cannot be written, it is not allowed there"
            raise InputError(sentence(what, fix="name a file in a folder of yours"))


def check_figure(figure: Path | None) -> None:
    """Refuse formats that cannot be drawn."""
    if figure is not None and figure.suffix.lower() not in FIGURES:
        raise InputError(sentence(f"--figure {figure}", expected=f"a name ending in {', '.join(FIGURES)}"))


def check_apart(outputs: dict[str, Path | None], inputs: dict[str, Path]) -> None:
    """Refuse to write over what is read, or two things into one file."""
    taken = dict(inputs)
    for option, path in outputs.items():
        if path is None:
            continue
        for name, other in taken.items():
            same = path.exists() and other.exists() and path.samefile(other)
            if same or path.resolve() == other.resolve():
                raise InputError(sentence(f"{option} {path} is the file of {name}", fix="name another file"))
        taken[option] = path


def split_names(text: str) -> list[str]:
    """Names of columns, separated by commas."""
    return [name.strip() for name in text.split(",")]


def _if_given(text: str | None) -> list[str] | None:
    return None if text is None else split_names(text)


def position_columns(position: list[str]) -> list[list[str]]:
    """Column triples of all markers."""
    triples = [split_names(text) for text in position]
    for triple in triples:
        if len(triple) != 3:
            raise typer.BadParameter(f"expected three columns X,Y,Z, got {','.join(triple)}", param_hint="--position")
    return triples


def reading_options(convention: str, angle: str) -> str:
    """Options with which `evaluate` and `fit` read the poses that `predict` writes; the unit is that of the angles."""
    turn = Orientation.default(None, convention, angle, None, known=False)
    unit = f" --rotation-angle {angle}" * (len(turn.columns) == 3)
    return f"--position x,y,z --rotation {','.join(turn.columns)} --convention {convention}{unit}"


def separator(text: str) -> str:
    """What separates cells; a tab may be spelt out."""
    return "\t" if text in ("\\t", "tab") else text
