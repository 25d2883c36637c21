"""The options of the commands of a robot that is measured again."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from diffeo_calib.cli.options.shared import Angle, Length


class MarkerFreedom(str, Enum):
    """How far the markers may have moved on the tool."""

    evidence = "evidence"
    same = "same"
    moved = "moved"
    other = "other"


class Drift(str, Enum):
    """What may have changed in the robot itself."""

    tested = "tested"
    none = "none"


OldModel = Annotated[Path, typer.Argument(metavar="OLD", help="Model file of an earlier calibration.")]
Compared = Annotated[
    Path, typer.Argument(metavar="OTHER", help="Table of new measurements, or another model file of the same robot.")
]
ComparedPosition = Annotated[
    list[str] | None,
    typer.Option("--position", metavar="X,Y,Z", help="With a table: as for `fit`."),
]
ComparedLength = Annotated[Length | None, typer.Option("--length", help="With a table: as for `fit`.")]
ComparedAngle = Annotated[Angle | None, typer.Option("--angle", help="With a table: as for `fit`.")]
MarkerOption = Annotated[
    MarkerFreedom,
    typer.Option(
        "--marker",
        help="Whether the markers are the same (0.05 mm), have moved a little (1 mm) or are other ones; by default the "
        "rows decide.",
    ),
]
DriftOption = Annotated[
    Drift, typer.Option("--drift", help="tested: what a test names may have changed; none: device and markers only.")
]
Level = Annotated[
    float,
    typer.Option("--level", min=0.001, max=0.2, help="Probability that anything is named although nothing changed."),
]
ComparisonFigure = Annotated[
    Path | None, typer.Option("--figure", metavar="IMAGE", help="With a model: draw where the two differ.")
]
