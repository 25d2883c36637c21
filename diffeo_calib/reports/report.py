"""`write_report`: a calibration on one HTML page that needs neither a network nor a server."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from diffeo_calib.common.checks import check_number
from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import printable, shown
from diffeo_calib.common.files import check_writable, write_whole
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.result import Progress, silent
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.reports.analysis.findings import Findings, Kinematics, find
from diffeo_calib.reports.html import sections
from diffeo_calib.reports.html import sections as sentences
from diffeo_calib.reports.html.document import page
from diffeo_calib.sensors.coordinates import Places

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOG = logging.getLogger(__name__)


@small_work()
@outside_inference_mode
def write_report(
    model: CalibratedKinematics,
    path: str | os.PathLike[str],
    data: Any = None,
    *,
    title: str = "",
    stages: Mapping[str, Kinematics] | None = None,
    places: Mapping[str, Places] | None = None,
    warnings: Sequence[str] | None = None,
    against: Sequence[str] = (),
    tolerance: float | None = None,
    progress: Progress = silent,
) -> Findings:
    """Write a self-contained HTML page about a calibration.

    Args:
        model: the calibrated model.
        path: the file.
        data: rows of any kinds; rows of the fit, and of a registration, are left out. By default, and if no others are
            left, the rows of the fit are shown: measured positions each predicted by all others in closed form, rows of
            other kinds as fitted. A model with control points does not know its rows: pass them in their order.
        title: of the page, by default the robot's.
        stages: name -> kinematics (N, n) -> (N, P, 3) in m to compare, the model last; by default the nominal robot and
            the geometric calibration, base and markers where they fit best.
        places: of devices beside each of these stages; by default they are placed on the rows.
        warnings: to show first; by default those of the fit.
        against: further columns of the table that errors are shown against. Columns whose names speak of time or
            temperature are shown anyway.
        tolerance: RMS error of positions, m, up to which the robot is good enough: the page says whether it is.
        progress: called as ``progress(task, done, total)``.

    Returns:
        the numbers that the page shows.

    Raises:
        InputError: arguments of another kind, measurements that do not belong to the model, a column that the table
            does not have, or a file that cannot be written.
        MeasurementError: rows that another reading explains far better, or too few rows of a set-up.
    """
    check_writable(path)  # before the work
    if tolerance is not None:
        check_number(tolerance, "`tolerance`", above=0.0)
    found = find(model, data, stages=stages, places=places, against=against, progress=progress)
    robot, made, summary = model.robot, model.provenance, model.summary
    date = "" if made is None else f", fitted {made.date[:10]}"
    note = "" if made is None or not made.note else f". Note: {printable(made.note)}"
    fit, rows = f"{robot.n} joints, {len(model.configurations)} rows in the fit{date}{note}", sentences.rows_of(found)
    warned = (summary.warnings or "").splitlines() if summary else []
    sha256 = None if data is None or not found.new else data.sha256
    parts = [*sections.sections(found), sections.record(model, sha256)]
    drawn, drawings = [picture for section in parts for picture in section.pictures], dict[str, str]()
    for number, picture in enumerate(drawn):
        progress("drawing", number, len(drawn))
        drawings[picture.name] = picture.svg()
    text = page(
        title=printable(title or f"Robot {robot.name}, {robot.base} to {robot.tip}"),
        subtitle=f"{fit}. Errors: {rows}.",
        verdict=sentences.verdict(found, tolerance),
        warnings=warned if warnings is None else warnings,
        advice=list(sentences.advice(found)),
        figures=dict(sentences.figures(found)),
        sections=parts,
        drawings=drawings,
    )
    write_whole(path, text.encode())
    LOG.info("report written to %s", shown(path))
    return found


@small_work()
@outside_inference_mode
def pictures(model: CalibratedKinematics, data: Any = None, **how: Any) -> dict[str, Figure]:
    """The pictures of :func:`write_report`, by their names in the page, as figures of matplotlib.

    Args:
        model, data: as there. how: ``stages``, ``places`` and ``against`` as there.
    """
    findings = find(model, data, **how)
    return {picture.name: picture.figure() for section in sections.sections(findings) for picture in section.pictures}
