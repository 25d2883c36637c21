"""`diffeo-calib report`: a calibration on one HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diffeo_calib.cli.console import exit_on_interrupt, progress_bar, say
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.record import entries_by_kind, errors_entry, record
from diffeo_calib.cli.tables.measured import measured_table
from diffeo_calib.reports.analysis.findings import Findings
from diffeo_calib.reports.html import kinds, sentences
from diffeo_calib.reports.report import write_report


def run(options: Mapping[str, Any]) -> None:
    """Write the page, and say its first line; the options by name."""
    kinematics, output = load_kinematics(options["model"]), options["output"]
    source = None if options["data"] is None else measured_table({**options, "csv": options["data"]})
    data = None if source is None else source.read(kinematics.robot)
    given = {"title": options["title"], "against": options["against"] or []}
    with exit_on_interrupt(), progress_bar() as progress:
        found = write_report(kinematics, output, data, **given, progress=progress)
    for line in provenance_lines(kinematics):
        say(line)
    words: Any = sentences if isinstance(found, Findings) else kinds
    if isinstance(found, Findings):
        left_out, coverage = found.predictions.left_out, found.predictions.coverage()
        record.add(errors={name: errors_entry(errors) for name, errors in found.errors.items()}, coverage_95=coverage)
    else:
        left_out = not found.new
        record.add(**entries_by_kind(found.kinds), expected_error_by_stage_m=dict(found.expected))
    record.add(
        left_out=left_out, verdict=words.verdict(found), advice=list(words.advice(found)), files={"report": output}
    )
    if data is not None and left_out:
        each = "each predicted by all others" if isinstance(found, Findings) else "as fitted"
        say(f"all rows of the table were used before: the rows of the fit are shown, {each}")
    say(words.verdict(found))
    say(f"report: {output}")
