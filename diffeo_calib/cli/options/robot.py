"""The options that say which robot was measured, and in how many set-ups. Imports nothing slow."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Robot = Annotated[Path, typer.Option("--robot", metavar="URDF", help="The robot's description.")]
Base = Annotated[str, typer.Option("--base", metavar="LINK", help="First link of the chain.")]
Tip = Annotated[
    list[str],
    typer.Option(
        "--tip",
        metavar="LINK",
        help="Last link of the chain, to which the markers are fixed; for several tips once per --position.",
    ),
]
Load = Annotated[
    list[str] | None,
    typer.Option(
        "--load", metavar="LINK", help="Link of another branch, whose weight bends the robot; repeat for more."
    ),
]
Payload = Annotated[
    str | None,
    typer.Option("--payload", metavar="COLUMN", help="Column with the known mass that the robot carried, in any unit."),
]
ToolTips = Annotated[
    list[str] | None,
    typer.Option(
        "--tip",
        metavar="LINK",
        help="Link that carries the tool, for a model with several tips; repeat it where several tools have targets at "
        "the same time, with --tool, --position and --rotation once for each.",
    ),
]
ExportTip = Annotated[
    str | None,
    typer.Option("--tip", metavar="LINK", help="Tip at the end of --c and --dh, for a model with several tips."),
]
Mass = Annotated[
    float | None,
    typer.Option("--payload", metavar="MASS", help="Mass that the robot carries, for a model with payloads."),
]
Session = Annotated[
    str | None,
    typer.Option("--session", metavar="COLUMN", help="Column that names the set-up of the device for every row."),
]
