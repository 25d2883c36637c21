"""Sentences of a report: the verdict, what to do next, where and whether the model can be believed."""

from __future__ import annotations

from collections.abc import Iterator

from diffeo_calib.common.errors import printable
from diffeo_calib.common.quantiles import binomial_band, largest_known
from diffeo_calib.reports.analysis.findings import Findings
from diffeo_calib.reports.html.document import rough_millimetres
from diffeo_calib.reports.plots.panels import in_bins, joint_unit, joint_values
from diffeo_calib.sensors.errors import ERRORS

WORTHWHILE_ERROR_FACTOR = 1.1
"""More rows are not worth it where the forecast is less than this factor below the error now."""
ENOUGH_FOR_P95 = 20  # rows from which a 95th percentile means something
BAD_RATIO = 1.5  # ratio of the RMS error in a part of a joint's range to that of all rows from which the part is named


MISCALIBRATION_PROBABILITY = 0.05
"""Probability that regions of the right size hold so few errors, or so many, that they are called wrong."""


def rows_of(findings: Findings, count: int | None = None) -> str:
    """Source of the errors of a report, or of ``count`` of them, in words."""
    count = findings.count if count is None else count
    if not findings.kinds:
        return "none, because no rows were passed"
    if findings.new:
        return f"{count} rows that the model has not seen"
    if not findings.errors:
        return f"{count} rows of its own fit"
    return f"{count} rows of the fit, each predicted by {'all' if findings.rows.whole else 'hundreds of'} others"


def verdict(findings: Findings, tolerance: float | None = None) -> str:
    """The result in one line: whether a tolerance, m, is kept, errors by stage, and those of every other kind."""
    *before, (_, rms) = findings.rms.items()
    text = "".join(f"{1e3 * value:.2f} mm {printable(name)}, " for name, value in before)
    text += f"{1e3 * rms:.3f} mm calibrated"
    if (errors := findings.calibrated) is None:
        text += ": RMS errors of positions that the model expects over the joint ranges of its rows."
    else:
        many = errors.count >= ENOUGH_FOR_P95
        most = f"95 % of errors are below {1e3 * errors.p95:.3f}" if many else f"The largest is {1e3 * errors.max:.3f}"
        what = "noise of a measurement" if findings.telling is None else "repeatability"
        rows = rows_of(findings, len(errors.errors))
        text += f" (RMS), on {rows}. {most} mm; {what} about {1e3 * findings.limit:.3f} mm."
    text = f"{text} {'; '.join(f'{name}: {value} RMS' for name, value in _others(findings))}".strip()
    if tolerance is None:
        return text
    judged = findings.judged
    within = "Within" if judged.value <= tolerance else "Above"
    return f"{within} the tolerance of {1e3 * tolerance:g} mm: {1e3 * judged.value:.3f} mm RMS {judged.of}. {text}"


def _others(findings: Findings) -> Iterator[tuple[str, str]]:
    """Errors of the model in rows of other kinds than measured positions: what they are, and their RMS."""
    for errors in (kind.errors for kind in findings.kinds.values()):
        if not findings.errors or errors.what != ERRORS:
            unit, per_unit = errors.shown
            yield errors.title, f"{per_unit * errors.rms:.3f} {unit}"


def figures(findings: Findings) -> Iterator[tuple[str, str]]:
    """Name and value of the numbers at the top."""
    calibrated = findings.calibrated
    for name, value in findings.rms.items():
        yield f"expected error, {name}" if calibrated is None else f"{name}, RMS", f"{1e3 * value:.3f} mm"
    if calibrated is not None and calibrated.orientation is not None:
        yield "orientation, RMS", f"{calibrated.orientation.rms:.4f}\u00b0"
    if calibrated is not None and calibrated.count >= ENOUGH_FOR_P95:
        yield "95 % of errors below", f"{1e3 * calibrated.p95:.3f} mm"
    for name, value in _others(findings):
        yield f"{name}, RMS", value
    if findings.predictions is not None:
        inside, count = findings.predictions.inside()
        yield "inside claimed 95 % regions", f"{inside} of {count} ({100 * inside / count:.0f} %)"
    if findings.unlike:
        error = findings.deviations.error
        apart = f" ({rough_millimetres(error.whole)} with what the rows leave open)" * bool(error.open_places)
        yield "expected in poses unlike the measured", f"{rough_millimetres(error.workspace)} mm{apart}"
    if findings.telling is not None:
        yield "repeatability", f"{1e3 * findings.limit:.3f} mm"


def advice(findings: Findings) -> Iterator[str]:
    """Next steps, the most important first."""
    yield from findings.moved
    predicted = findings.predictions
    if predicted is not None and findings.outliers:
        wrong = {one.row for one in findings.outliers}
        good = [row for row in range(len(predicted)) if row not in wrong]
        rest = 1e3 * float(predicted.errors.errors[good].square().nanmean().sqrt())
        text = f"{len(wrong)} of {len(predicted)} rows look wrong: check them, see below"
        yield f"{text}; without them {rest:.3f} mm RMS." if good else f"{text}."
    yield from unlike_poses(findings)
    if findings.moved:
        return
    for one in findings.kinds.values():
        *others, (_, last) = one.stages.items()
        before, rival = min(others, key=lambda stage: stage[1].rms)
        if last.rms >= rival.rms:
            of = f"{last.title}: the" if len(findings.kinds) > 1 else "The"
            yield f"{of} model is no better than the {before} one on these rows: measure more poses."
    if findings.kinds and not findings.new and not findings.errors:
        yield "These are rows of the fit: pass rows that the model has not seen."
    if not findings.learning_curve or findings.learning_curve[-1][0] < len(findings.rows):
        return
    if findings.forecast is None:
        yield f"More poses like these will hardly lower the error{_unless_planned(findings)}."
        return
    (rows, error), (_, now) = findings.forecast, findings.learning_curve[-1]
    change = f"{1e3 * error:.3f} mm instead of {1e3 * now:.3f} mm"
    if now > WORTHWHILE_ERROR_FACTOR * error:
        most = "the poses that help most are listed under Where"
        yield f"Twice as many poses ({rows}) would bring about {change}; {most}."
    else:
        change += _unless_planned(findings)
        yield f"More poses like these will hardly help: twice as many ({rows}) would bring {change}."


def _unless_planned(findings: Findings) -> str:
    """That planned poses help where more of the same do not, if they do."""
    plan = findings.deviations.next
    now, then = (0.0, 0.0) if plan is None else (float(plan.expected_rms[count]) for count in (0, -1))
    if plan is None or now < WORTHWHILE_ERROR_FACTOR * then:
        return ""
    lower = f"from {rough_millimetres(now)} to {rough_millimetres(then)} mm"
    return f"; those listed under Where lower the error expected anywhere in the joint ranges {lower}"


def unlike_poses(findings: Findings) -> Iterator[str]:
    """A sentence about poses unlike the measured ones if they are much less certain, and why."""
    error, why, what = findings.deviations.error, "", "unlike them"
    if not findings.unlike:
        return
    if error.open_places:
        why = f", because the rows leave {' and '.join(error.open_places)} open"
        what = "in which the tool is turned about other axes"
    far = f"elsewhere errors of {rough_millimetres(error.whole)} mm are expected{why}"
    what = f"To change that, measure poses {what}, such as those listed under Where."
    yield f"Use the model near the measured poses: {far}. {what}"


def worst_range(findings: Findings) -> Iterator[str]:
    """A sentence about the part of a joint's range with the largest errors, if they are unusual."""
    rows, robot = findings.predictions, findings.model.robot
    if rows is None:
        return
    lengths, most, where = 1e3 * largest_known(rows.errors.errors), BAD_RATIO * 1e3 * rows.errors.rms, ""
    for joint, name in enumerate(robot.joint_names):
        for low, high, group in in_bins(joint_values(robot, joint, rows.data.q[:, joint]), lengths):
            rms = float(group.square().mean().sqrt())
            if rms > most:
                unit, most = joint_unit(robot, joint), rms
                where = f"{name} between {low:.0f} and {high:.0f} {unit} ({len(group)} rows): {rms:.3f} mm RMS"
    if where:
        yield f"The largest errors are found with {where}."


def judged(findings: Findings) -> str:
    """Whether the claimed regions can be believed, as far as the number of rows tells."""
    if findings.predictions is None:
        none = "No position was measured that the model has not seen, so the regions that it claims cannot be"
        return f"{none} compared with errors."
    inside, count = findings.predictions.inside()
    low, high = binomial_band(count, 0.95, MISCALIBRATION_PROBABILITY)
    if inside < low:
        what = "these are too small: widen the model's deviations, or measure more poses like these"
    elif inside > high:
        what = "these are cautious"
    else:
        what = "these, which contain the noise of a measurement, agree with that for poses like the ones shown"
    hold = f"{low} to {high}" if low < high else f"all {high}"
    right = f"Of {count} errors, regions of the right size hold {hold} in nine cases of ten; {what}."
    return f"{inside} of {count} errors lie in the regions that claim 95 %. {right}"
