"""The command that proposes a campaign file. It imports its work when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffeo_calib.cli.app import app
from diffeo_calib.cli.options import report as report_options
from diffeo_calib.cli.options import shared as options
from diffeo_calib.cli.places import check_outputs

CampaignOutput = Annotated[Path, typer.Option("-o", "--output", metavar="TOML", help="Campaign file to write.")]
CampaignRobot = Annotated[Path, typer.Argument(metavar="URDF", help="The robot's description.")]


Force = Annotated[bool, typer.Option("--force", help="Replace a campaign file that was edited.")]


@app.command("init")
def init_command(
    csv: options.CsvPath,
    urdf: CampaignRobot,
    output: CampaignOutput = Path("campaign.toml"),
    force: Force = False,
    _json: report_options.Json = None,
) -> None:
    """Propose the options of `fit` for a table and a URDF.

    Looks at names, numbers and plausible units, and writes a campaign file with a reason for every line. Check it, then
    run `diffeo-calib fit campaign.toml`.
    """
    check_outputs({"-o": output}, {"CSV": csv, "URDF": urdf})
    from diffeo_calib.cli.commands import init  # noqa: PLC0415

    init.run(csv, urdf, output, force=force)
