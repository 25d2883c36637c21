"""The options of `fit`: a calibration by measured positions, by sockets, or by readings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diffeo_calib.cli.commands import fit
from diffeo_calib.cli.options.readings import check_readings


def run(options: Mapping[str, Any]) -> None:
    """Run the command with its options by name."""
    chosen = {name: options[name] for name in ("holdout", "seed", "note")}
    check_readings(options)
    outputs = fit.Outputs(options["output"], options["figure"], options["report"])
    fit.run(*fit.inputs(options), outputs, controls=options["controls"], **chosen)
