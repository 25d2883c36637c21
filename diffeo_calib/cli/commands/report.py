"""`diffeo-calib report`: a calibration on one HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from diffeo_calib.cli.console import exit_on_interrupt, progress_bar, say
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.record import errors_entry, record
from diffeo_calib.cli.tables.positions import MeasuredTable
from diffeo_calib.reports.html.sentences import advice, verdict
from diffeo_calib.reports.report import write_report


def run(model: Path, source: MeasuredTable | None, output: Path, title: str, against: Sequence[str]) -> None:
    """Write the page, and say its first line."""
    kinematics = load_kinematics(model)
    data = None if source is None else source.read(kinematics.robot)
    with exit_on_interrupt(), progress_bar() as progress:
        found = write_report(kinematics, output, data, title=title, against=against, progress=progress)
    record.add(
        errors={name: errors_entry(errors) for name, errors in found.errors.items()},
        left_out=found.predictions.left_out,
        coverage_95=found.predictions.coverage(),
        verdict=verdict(found),
        advice=list(advice(found)),
        files={"report": output},
    )
    for line in provenance_lines(kinematics):
        say(line)
    if data is not None and found.predictions.left_out:
        say("all rows of the table were used before: the rows of the fit are shown, each predicted by all others")
    say(verdict(found))
    say(f"report: {output}")
