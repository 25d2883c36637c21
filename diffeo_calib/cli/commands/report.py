"""`diffeo-calib report`: a calibration on one HTML page."""

from __future__ import annotations

from diffeo_calib.cli.console import progress_bar, say
from diffeo_calib.cli.models import load_kinematics, provenance_lines, table_of
from diffeo_calib.cli.options import Command
from diffeo_calib.cli.printed import expectation_lines, parsed_length
from diffeo_calib.cli.record import entries_by_kind, record
from diffeo_calib.common.errors import InputError
from diffeo_calib.reports.analysis.findings import unseen
from diffeo_calib.reports.html.sentences import advice, verdict
from diffeo_calib.reports.report import write_report


def run(wanted: Command) -> None:
    """Write the page, and say its first line."""
    model, data = load_kinematics(wanted.model), None
    if wanted.data is not None:
        data = table_of(model, wanted.data, wanted.rows, wanted.units).read(model.robot)
    tolerance = parsed_length(wanted.tolerance, "--tolerance")
    if tolerance is not None and data is not None and not bool(unseen(model, data.q).any()):
        expected, fix = "rows that took no part in fit and registration", "measure more rows, or leave --data out"
        raise InputError.of("rows to hold against --tolerance", expected=expected, got=f"{len(data)} that did", fix=fix)
    how = {"against": wanted.against or [], "tolerance": tolerance}
    with progress_bar() as progress:
        found = write_report(model, wanted.output, data, **how, progress=progress)
    say(*provenance_lines(model))
    words, stages = verdict(found, tolerance), dict(found.expected)
    record.add(**entries_by_kind(found.kinds), expected_error_by_stage_m=stages, left_out=not found.shown.new)
    record.add(verdict=words, advice=list(advice(found)), files={"report": wanted.output})
    if found.shown.predictions is not None:
        record.add(coverage_95=found.shown.predictions.coverage())
    if data is not None and not found.shown.new:
        each = "as fitted" if not found.errors else "each predicted by all others"
        say(f"all rows of the table were used before: the rows of the fit are shown, {each}")
    say(words, *expectation_lines(model, None, found.deviations.error), f"report: {wanted.output}")
