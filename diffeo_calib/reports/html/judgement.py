"""The sections of a report that judge: can the model be trusted, and how repeatable is the robot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from diffeo_calib.calibration.findings import Outlier
from diffeo_calib.common.errors import printable
from diffeo_calib.reports.analysis.findings import Findings
from diffeo_calib.reports.analysis.repeats import STANDARD_REPEATS
from diffeo_calib.reports.html import sentences
from diffeo_calib.reports.html.document import Picture, Section, Table
from diffeo_calib.reports.html.pieces import joint_values_by_row, marker_name, millimetres, panel
from diffeo_calib.reports.plots.joints import joint_label, joint_values
from diffeo_calib.reports.plots.trust import draw_coverage, draw_learning_curve, draw_residuals

LARGEST = 5
"""Rows with the largest errors that are listed."""
MOST_OUTLIERS = 20
"""Rows that look wrong that are listed."""
MOST_REPEATS = 12
"""Repeated poses that are listed."""


def trust(found: Findings) -> Section:
    """Claimed against found errors, residuals, outliers, learning curve."""
    share = 100 * found.predictions.coverage()
    see = f"{share:.0f} % of the errors lie in the regions that claim 95 %. {sentences.judged(found)}"
    tables = [_outliers(found.outliers, found.model.on)] if found.outliers else []
    tables.append(_largest(found))
    notes = list(found.moved)
    registered = found.model.registration
    if registered is not None:
        notes.append(
            f"The model was registered anew with {registered.rows} rows, RMS {millimetres(registered.rms_after)} mm; "
            f"each predicted by the others {millimetres(registered.left_out_rms)} mm."
        )
    elif not notes:
        notes.append("No device or marker moved, and no block of rows is wrong.")
    if not found.outliers and not found.moved:
        notes.append(
            "No row looks wrong: none is further from its prediction than chance allows in a table of this size (1 %), "
            "by the model's own deviations."
        )
    return Section("trust", "Can I trust it", see, tables, None, [*_certainty(found), *_residuals(found)], notes)


def _certainty(found: Findings) -> Iterator[Picture]:
    """What the model claims, and what it would claim with fewer rows."""
    label = "Found against claimed shares of errors; on the diagonal the claims are true."
    yield panel("coverage", label, draw_coverage, found.predictions)
    if found.learning_curve:
        label = "Error of rows of the fit when a model knows fewer of them, each row left out in turn."
        limit = found.limit if found.repeats else None
        yield panel("learning", label, draw_learning_curve, found.learning_curve, found.forecast, limit)


def _residuals(found: Findings) -> Iterator[Picture]:
    """Errors against the row, time and temperature, and every joint."""
    seen, robot = found.predictions, found.model.robot
    columns = {"row": seen.data.line_numbers.double(), **found.columns}
    for number, (name, values) in enumerate(columns.items()):
        label = f"Errors against {printable(name)}, their RMS dashed: a trend is a drift."
        missing = int((~values.isfinite()).sum())
        label += f" {missing} of {len(values)} rows have no value." * (missing > 0)
        yield panel(f"residuals-{number}", label, draw_residuals, values, seen, printable(name), key=number == 0)
    for joint, name in enumerate(robot.joint_names):
        values = joint_values(robot, joint, seen.data.q[:, joint])
        label = f"Errors against {printable(name)}, their RMS dashed."
        what = values, seen, joint_label(robot, joint)
        yield panel(f"residuals-joint-{joint}", label, draw_residuals, *what, key=False)


def _largest(found: Findings) -> Table:
    """The rows with the largest errors, beside what the model expects there."""
    seen, robot = found.predictions, found.model.robot
    errors, body = seen.errors.errors.nan_to_num(0.0).max(1)  # hidden markers have no error
    order = errors.argsort(descending=True)[:LARGEST].tolist()
    joints = joint_values_by_row(robot, seen.data.q[order])
    lines = [
        ["error [mm]", *(millimetres(float(errors[row])) for row in order)],
        ["expected RMS [mm]", *(millimetres(float(seen.claimed[row, body[row]])) for row in order)],
        *joints,
    ]
    if seen.measured.shape[1] > 1:
        lines.insert(0, ["marker", *(marker_name(int(body[row]), found.model.on) for row in order)])
    header = ["row", *(str(int(seen.data.line_numbers[row])) for row in order)]
    return Table("Largest errors, and what the model expects of a measurement there", header, lines)


def _outliers(outliers: Sequence[Outlier], tips: Sequence[str]) -> Table:
    rows = [
        [
            str(one.number),
            "" if one.marker is None else marker_name(one.marker, tips),
            millimetres(one.distance),
            one.reason,
        ]
        for one in outliers[:MOST_OUTLIERS]
    ]
    more = f" (the worst {MOST_OUTLIERS} of {len(outliers)})" if len(outliers) > MOST_OUTLIERS else ""
    return Table(
        f"Rows that look wrong{more}; none was dropped", ["row", "marker", "off by [mm]", "why"], rows, numeric=False
    )


def repeatability(found: Findings) -> Section:
    """Figures of ISO 9283, where poses were repeated."""
    repeats = found.repeats
    if repeats is None:
        see = "No pose was measured twice: pose accuracy and repeatability (ISO 9283) cannot be told from these rows."
        note = "Repeat five poses, 30 times each, and pass the table with --data."
        return Section("repeatability", "Repeatability", see, notes=[note])
    names = list(repeats.accuracy)
    header = ["pose", "measured", "RP [mm]", *(f"AP {name} [mm]" for name in names)]
    rows = [
        [
            f"row {int(line)}",
            str(int(count)),
            millimetres(float(rp)),
            *(millimetres(float(repeats.accuracy[name][k])) for name in names),
        ]
        for k, (line, count, rp) in enumerate(zip(repeats.lines, repeats.counts, repeats.repeatability, strict=True))
    ][:MOST_REPEATS]
    worst = ["worst", "", millimetres(float(repeats.repeatability.max()))]
    mean = ["mean", "", millimetres(float(repeats.repeatability.mean()))]
    for name in names:
        worst.append(millimetres(float(repeats.accuracy[name].max())))
        mean.append(millimetres(float(repeats.accuracy[name].mean())))
    see = (
        f"{len(repeats.counts)} poses were measured several times: single measurements are "
        f"{millimetres(repeats.deviation)} mm RMS away from their mean, which limits the RMS error of any model."
    )
    few = int(repeats.counts.min()) < STANDARD_REPEATS
    notes = [
        "As ISO 9283 defines them for positions: pose accuracy AP is the distance of the mean measured place from the "
        "commanded one, repeatability RP the mean distance of the measurements from their mean plus three standard "
        "deviations of it"
        + f", from fewer than its {STANDARD_REPEATS} attainments" * few
        + ". Accuracy with the model is predicted: measure it again after the commands are corrected."
    ]
    caption = "Pose accuracy (AP) and repeatability (RP)" + f", the first {MOST_REPEATS} poses" * (
        len(repeats.counts) > MOST_REPEATS
    )
    return Section("repeatability", "Repeatability", see, [Table(caption, header, [*rows, worst, mean])], notes=notes)
