"""The options of `evaluate`: errors on measured positions, on sockets, or on readings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diffeo_calib.cli.commands import acceptance, evaluate, evaluate_readings, evaluate_sessions, evaluate_sockets
from diffeo_calib.cli.options.readings import check_readings, check_session
from diffeo_calib.cli.tables.measured import measured_table


def run(options: Mapping[str, Any]) -> None:
    """Run the command with its options by name."""
    model, of_readings = options["model"], check_readings(options)
    check_session(options["session"], register=options["register"])
    if of_readings:
        limit = acceptance.limit_m(options["fail_above"])
        return evaluate_readings.run(model, measured_table(options), limit=limit)
    source = measured_table(options)
    if not options["register"]:
        limit = acceptance.limit_m(options["fail_above"])
        if source.sockets is not None:
            return evaluate_sockets.run(model, source, limit=limit)
        if source.session is not None:
            return evaluate_sessions.run(model, source, limit=limit, residuals=options["residuals"])
        return evaluate.run(model, source, limit=limit, residuals=options["residuals"])
    free = "both" if options["free"] is None else options["free"].value
    evaluate.run_registered(model, source, free, options["output"])
