"""`write_report`: a calibration on one HTML page that needs neither a network nor a server."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence

from diffeo_calib.common.errors import printable
from diffeo_calib.common.files import write_whole
from diffeo_calib.common.inference_mode import outside_inference_mode
from diffeo_calib.common.threads import small_work
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.reports.analysis.findings import Findings, find
from diffeo_calib.reports.analysis.stages import Kinematics
from diffeo_calib.reports.html import record, sections
from diffeo_calib.reports.html.document import Page

ENOUGH = 1.1
"""More rows are not worth it where the forecast is less than this factor below the error now."""


@small_work()
@outside_inference_mode
def write_report(
    model: CalibratedKinematics,
    path: str | os.PathLike[str],
    data: Measurements | None = None,
    *,
    title: str = "",
    stages: Mapping[str, Kinematics] | None = None,
    against: Sequence[str] = (),
) -> Findings:
    """Write a self-contained HTML page about a calibration.

    Args:
        model: the calibrated model.
        path: the file.
        data: measurements; rows of the fit among them are left out. By default, and with fewer than five new rows, the
            rows of the fit are shown, each predicted by all others in closed form.
        title: of the page, by default the robot's.
        stages: name -> kinematics (N, n) -> (N, P, 3) in m to compare, the model last; by default the nominal robot and
            the geometric calibration, base and markers where they fit best.
        against: further columns of the table that errors are shown against. Columns whose names speak of time or
            temperature are shown anyway.

    Returns:
        the numbers that the page shows.

    Raises:
        InputError: arguments of another kind, measurements that do not belong to the model, a column that the table
            does not have, or a file that cannot be written.
    """
    found = find(model, data, stages=stages, against=against)
    write_whole(path, page(found, title, None if data is None else data.sha256).html().encode())
    return found


def page(found: Findings, title: str, data_sha256: str | None) -> Page:
    """The page about these findings."""
    model = found.model
    robot = f"{model.robot.base} to {model.robot.tip}"
    made = "" if model.provenance is None else f", fitted {model.provenance.date[:10]}"
    fit = f"{model.robot.n} joints, {len(model.configurations)} rows in the fit{made}"
    return Page(
        title=printable(title) or f"Robot {robot}",
        subtitle=f"{fit}. Errors: {sections.rows_of(found)}.",
        verdict=verdict(found),
        advice=list(advice(found)),
        figures=dict(_figures(found)),
        sections=[
            sections.how_good(found),
            sections.where(found),
            sections.why(found),
            sections.trust(found),
            sections.repeatability(found),
            record.record(found, data_sha256),
        ],
    )


def verdict(found: Findings) -> str:
    """The result in one line."""
    *before, (_, own) = found.errors.items()
    stages = ", ".join(f"{1e3 * errors.rms:.2f} mm {name}" for name, errors in before)
    what = "repeatability" if found.repeats is not None else "noise of a measurement"
    return (
        f"{stages}, {1e3 * own.rms:.3f} mm calibrated (RMS), on {sections.rows_of(found)}. 95 % of errors are below "
        f"{1e3 * own.p95:.3f} mm; {what} about {1e3 * found.limit:.3f} mm."
    )


def advice(found: Findings) -> Iterator[str]:
    """What to do next, the most important first."""
    yield from found.moved
    if found.outliers:
        wrong = len({one.row for one in found.outliers})
        yield f"{wrong} of {len(found.predictions)} rows look wrong: check them, see below."
    *_, (before, rival), (_, own) = found.errors.items()
    if own.rms >= rival.rms:
        yield f"The model is no better than the {before} one on these rows: measure more poses."
    if not found.learning_curve:
        return
    if found.forecast is None:
        yield "More poses of this kind will hardly lower the error."
        return
    rows, error = found.forecast
    now = found.learning_curve[-1][1]
    if now > ENOUGH * error:
        yield (
            f"Twice as many poses ({rows}) would bring about {1e3 * error:.3f} mm instead of {1e3 * now:.3f} mm; "
            "the poses that help most are listed under Where."
        )
    else:
        change = f"{1e3 * error:.3f} mm instead of {1e3 * now:.3f} mm"
        yield f"More poses will hardly help: twice as many ({rows}) would bring {change}."


def _figures(found: Findings) -> Iterator[tuple[str, str]]:
    for name, errors in found.errors.items():
        yield f"{name}, RMS", f"{1e3 * errors.rms:.3f} mm"
    *_, own = found.errors.values()
    if own.angle_rms is not None:
        yield "orientation, RMS", f"{own.angle_rms:.4f}\u00b0"
    yield "95 % of errors below", f"{1e3 * own.p95:.3f} mm"
    yield "in 95 % regions", f"{100 * found.predictions.coverage():.0f} %"
    if found.repeats is not None:
        yield "repeatability", f"{1e3 * found.limit:.3f} mm"
