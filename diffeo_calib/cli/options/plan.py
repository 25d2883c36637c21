"""The options of `plan`: their types and their help. Imports nothing slow, so that help appears at once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffeo_calib.cli.options.shared import LARGEST_SEED, Free

DRAWN = 3000
FACING_HALF_ANGLE_DEG = 45.0

PlannedModel = Annotated[
    Path | None,
    typer.Argument(metavar="MODEL", help="Model file written by `fit`, to plan the next poses; or name a --robot."),
]
PlannedRobot = Annotated[
    Path | None, typer.Option("--robot", metavar="URDF", help="The robot's description, to plan the first poses.")
]
PlannedBase = Annotated[
    str | None, typer.Option("--base", metavar="LINK", help="With --robot: first link of the chain.")
]
PlannedTip = Annotated[
    list[str] | None,
    typer.Option(
        "--tip",
        metavar="LINK",
        help="With --robot: last link of the chain; the markers are fixed to it. Repeat for more: each has them.",
    ),
]
Count = Annotated[int, typer.Option("-n", "--count", min=1, help="Number of poses to plan.")]
PlanOutput = Annotated[
    Path, typer.Option("-o", "--output", metavar="CSV", help="Table of poses to write: the joints, and a rank.")
]
CandidatesTable = Annotated[
    Path | None,
    typer.Option("--candidates", metavar="CSV", help="Choose from these configurations instead of random ones."),
]
Draw = Annotated[
    int | None,
    typer.Option("--draw", min=1, help=f"Number of random candidates to choose from, {DRAWN} by default."),
]
PlanSeed = Annotated[int, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Seed of the random candidates.")]
TargetTable = Annotated[
    Path | None,
    typer.Option(
        "--target", metavar="CSV", help="Configurations at which the robot shall be accurate; by default everywhere."
    ),
]
MeasuredRows = Annotated[
    Path | None,
    typer.Option("--measured", metavar="CSV", help="Configurations that are measured already but not in the model."),
]
PlannedFree = Annotated[
    Free | None,
    typer.Option("--free", help="With MODEL: what has moved since its fit; base is the device's or the robot's."),
]
Markers = Annotated[
    list[str] | None,
    typer.Option(
        "--marker",
        metavar="X,Y,Z",
        help="With --robot: place of a marker in the frame of the tip, in the unit of --length; repeat for more. By "
        "default 0.1 m beside and 0.1 m in front of the tip.",
    ),
]
SensorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--sensor",
        metavar="KIND[=NUMBERS]",
        help="What will measure; by default what the rows of MODEL were measured with, or a tracker. `tracker`, "
        "`poses`, or a device, roughly where it will stand in the base frame: `distance=X,Y,Z` from this point "
        "(`displacement=`: with an unknown zero), `height=NX,NY,NZ,D` above the plane with this normal at this distance "
        "from the base, "
        "`image=X,Y,Z,TX,TY,TZ` of a camera there that looks at the second point, `socket=X,Y,Z`. Repeat for more.",
    ),
]
Ranges = Annotated[
    list[str] | None,
    typer.Option(
        "--range",
        metavar="JOINT=A:B",
        help="Range of a joint within its limits; by default these, but one turn at most. Repeat for more joints.",
    ),
]
TrackerPlace = Annotated[
    str | None,
    typer.Option(
        "--tracker",
        metavar="X,Y,Z",
        help="Place of the measuring device in the robot's base frame: plan only poses in which it sees the marker.",
    ),
]
Facing = Annotated[
    str | None,
    typer.Option(
        "--facing",
        metavar="X,Y,Z",
        help="With --tracker: direction in which the marker looks, in the frame of the tip; 0,0,1 by default.",
    ),
]
Cone = Annotated[
    float | None,
    typer.Option(
        "--cone",
        metavar="DEG",
        help="With --tracker: largest angle between that direction and the line to the device, "
        f"{FACING_HALF_ANGLE_DEG:g} by default.",
    ),
]
Floor = Annotated[
    float | None,
    typer.Option("--floor", metavar="Z", help="Height in the base frame below which no link and no marker may be."),
]
Column = Annotated[
    str | None,
    typer.Option(
        "--column",
        metavar="X,Y,R[,TOP]",
        help="Upright cylinder in the base frame that no link may enter: place, radius, and top if it ends.",
    ),
]
Collisions = Annotated[
    bool,
    typer.Option(
        "--collisions", help="Leave out poses in which the robot collides with itself, by its URDF; needs pinocchio."
    ),
]
