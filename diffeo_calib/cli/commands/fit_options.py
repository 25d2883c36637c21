"""The options of `fit`: a calibration by measured positions, by sockets, or by readings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diffeo_calib.cli.commands import fit, fit_readings
from diffeo_calib.cli.options.readings import check_readings
from diffeo_calib.cli.tables.measured import measured_table


def run(options: Mapping[str, Any]) -> None:
    """Run the command with its options by name."""
    chosen = {name: options[name] for name in ("holdout", "seed", "note")}
    if check_readings(options):
        links = options["base"], options["tip"], options["load"] or ()
        robot = fit.RobotFile(options["robot"], *links)
        return fit_readings.run(robot, measured_table(options), options["output"], **chosen)
    outputs = fit.Outputs(options["output"], options["figure"], options["report"])
    fit.run(*fit.inputs(options), outputs, controls=options["controls"], **chosen)
