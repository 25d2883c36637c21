"""The command that needs no robot: demo. It imports its work when it runs."""

from __future__ import annotations

from pathlib import Path

from diffeo_calib.cli.app import app
from diffeo_calib.cli.options import report as report_options
from diffeo_calib.cli.options import shared as options
from diffeo_calib.cli.places import make_folder
from diffeo_calib.common.errors import InputError


@app.command("demo")
def demo_command(
    output: options.FolderOutput = Path("demo_output"),
    rows: options.DemoRows = None,
    seed: options.DemoSeed = None,
    paper: options.Paper = False,
    _json: report_options.Json = None,
) -> None:
    """Simulate a robot and calibrate it as a user would.

    The robot is an elastic six-axis arm, measured by a laser tracker. --paper takes the arm of the paper instead.
    """
    if paper and not (rows is None and seed is None):
        what = "--rows and --seed belong to the simulated arm: section 5 of the paper has 256 points without noise"
        raise InputError.of(what, fix="leave them out, or leave --paper out")
    make_folder(output)
    from diffeo_calib.cli.commands import demo  # noqa: PLC0415

    if paper:
        demo.run_paper(output)
        return
    app(demo.simulate(output, rows=options.DEMO_ROWS if rows is None else rows, seed=0 if seed is None else seed))
