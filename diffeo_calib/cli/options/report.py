"""The options of reports."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffeo_calib.cli.places import check_outputs
from diffeo_calib.cli.record import record

ReportOutput = Annotated[Path, typer.Option("-o", "--output", metavar="HTML", help="Page to write.")]
FitReport = Annotated[
    Path | None,
    typer.Option(
        "--report", metavar="HTML", help="Also write the report: one page that needs neither a network nor a server."
    ),
]
ShownTable = Annotated[
    Path | None,
    typer.Option(
        "--data",
        metavar="TABLE",
        help="Measurements to judge the model by; by default the rows of its fit, each predicted by all others.",
    ),
]
Title = Annotated[str, typer.Option("--title", metavar="TEXT", help="Title of the page; the robot by default.")]
Against = Annotated[
    list[str] | None,
    typer.Option(
        "--against",
        metavar="COLUMN",
        help="Further column of the table to show errors against; repeat for more. Time and temperature are found by "
        "their names.",
    ),
]


def _remember(path: Path | None) -> Path | None:
    """The command writes its results to this file when it ends."""
    if path is not None:
        record.path = path
        check_outputs({}, {})
    return path


Json = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        callback=_remember,
        help="Also write the results to this file, for programs (result.schema.json).",
    ),
]
