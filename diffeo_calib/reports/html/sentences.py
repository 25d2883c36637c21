"""Sentences of a report: the verdict, what to do next, where and whether the model can be believed."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from diffeo_calib.calibration.expected_errors import STILL_RANGE
from diffeo_calib.common.errors import printable
from diffeo_calib.common.quantiles import binomial_band, largest_known
from diffeo_calib.reports.analysis.findings import PositionFindings
from diffeo_calib.reports.html.document import rough_millimetres
from diffeo_calib.reports.plots.joints import in_bins, joint_values

WORTHWHILE_ERROR_FACTOR = 1.1
"""More rows are not worth it where the forecast is less than this factor below the error now."""
FAR_RATIO = 3.0
"""Ratio of expected errors anywhere to those like the measured ones from which the reason is told."""
BLAMED_VARIANCE_SHARE = 0.5
"""Share of the expected variance that knowing the markers would remove, from which they are blamed."""
OPEN_M = 1e-3
"""Deviation of a marker, m, in a direction that the rows leave open, from which it is blamed."""
ENOUGH_FOR_P95 = 20
"""Rows from which a 95th percentile means something."""
BAD_RATIO = 1.5
"""Ratio of the RMS error in a part of a joint's range to that of all rows from which the part is named."""


MISCALIBRATION_PROBABILITY = 0.05
"""Probability that regions of the right size hold so few errors, or so many, that they are called wrong."""


def rows_of(found: PositionFindings) -> str:
    """Source of the errors of a report, in words."""
    count = len(found.predictions)
    if found.predictions.left_out:
        return f"{count} poses of the fit, each predicted by {'all' if found.rows.whole else 'hundreds of'} others"
    return f"{count} poses that the model has not seen"


def verdict(found: PositionFindings) -> str:
    """The result in one line."""
    *before, (_, own) = found.errors.items()
    stages = ", ".join(f"{1e3 * errors.rms:.2f} mm {name}" for name, errors in before)
    many = len(found.predictions) >= ENOUGH_FOR_P95
    most = f"95 % of errors are below {1e3 * own.p95:.3f} mm;" if many else f"The largest is {1e3 * own.max:.3f} mm;"
    telling = found.repeats is not None and found.repeats.telling
    what = "repeatability" if telling else "noise of a measurement"
    found_on = f"{stages}, {1e3 * own.rms:.3f} mm calibrated (RMS), on {rows_of(found)}"
    return f"{found_on}. {most} {what} about {1e3 * found.limit:.3f} mm."


def figures(found: PositionFindings) -> Iterator[tuple[str, str]]:
    """Name and value of the numbers at the top."""
    for name, errors in found.errors.items():
        yield f"{name}, RMS", f"{1e3 * errors.rms:.3f} mm"
    *_, own = found.errors.values()
    if own.angle_rms is not None:
        yield "orientation, RMS", f"{own.angle_rms:.4f}\u00b0"
    if len(found.predictions) >= ENOUGH_FOR_P95:
        yield "95 % of errors below", f"{1e3 * own.p95:.3f} mm"
    inside, count = found.predictions.inside()
    yield "inside claimed 95 % regions", f"{inside} of {count} ({100 * inside / count:.0f} %)"
    error = found.deviations.error
    if error.whole > FAR_RATIO * error.measured:
        apart = f" ({rough_millimetres(error.whole)} with what the rows leave open)" * bool(error.open_places)
        yield "expected in poses unlike the measured", f"{rough_millimetres(error.workspace)} mm{apart}"
    if found.repeats is not None and found.repeats.telling:
        yield "repeatability", f"{1e3 * found.limit:.3f} mm"


def advice(found: PositionFindings) -> Iterator[str]:
    """Next steps, the most important first."""
    yield from found.moved
    if found.outliers:
        wrong = {one.row for one in found.outliers}
        good = [row for row in range(len(found.predictions)) if row not in wrong]
        text = f"{len(wrong)} of {len(found.predictions)} rows look wrong: check them, see below"
        rest = found.predictions.errors.errors[good].square().nanmean().sqrt()
        yield f"{text}; without them {1e3 * float(rest):.3f} mm RMS." if good else f"{text}."
    yield from unlike_poses(found)
    yield from still_joints(found)
    if found.moved:
        return
    *others, (_, own) = found.errors.items()
    before, rival = min(others, key=lambda stage: stage[1].rms)
    if own.rms >= rival.rms:
        yield f"The model is no better than the {before} one on these rows: measure more poses."
    if not found.learning_curve or found.learning_curve[-1][0] < len(found.rows):
        return
    if found.forecast is None:
        yield f"More poses like these will hardly lower the error{_unless_planned(found)}."
        return
    rows, error = found.forecast
    now = found.learning_curve[-1][1]
    if now > WORTHWHILE_ERROR_FACTOR * error:
        yield (
            f"Twice as many poses ({rows}) would bring about {1e3 * error:.3f} mm instead of {1e3 * now:.3f} mm; "
            "the poses that help most are listed under Where."
        )
    else:
        change = f"{1e3 * error:.3f} mm instead of {1e3 * now:.3f} mm{_unless_planned(found)}"
        yield f"More poses like these will hardly help: twice as many ({rows}) would bring {change}."


def _unless_planned(found: PositionFindings) -> str:
    """That planned poses help where more of the same do not, if they do."""
    plan = found.deviations.next
    now, then = (0.0, 0.0) if plan is None else (float(plan.expected_rms[count]) for count in (0, -1))
    if plan is None or now < WORTHWHILE_ERROR_FACTOR * then:
        return ""
    lower = f"from {rough_millimetres(now)} to {rough_millimetres(then)} mm"
    return f"; those listed under Where lower the error expected anywhere in the joint ranges {lower}"


def unlike_poses(found: PositionFindings) -> Iterator[str]:
    """A sentence about poses unlike the measured ones if they are much less certain, and why."""
    expected, model = found.deviations, found.model
    if expected.error.whole < FAR_RATIO * expected.error.measured:
        return
    tool = torch.arange(model.nominal.geometry.size, device=found.rows.q.device)
    tool = tool[model.nominal.geometry.slices["tool"]]
    open_directions = found.rows.map.open_directions[tool]
    variances = found.rows.map.parameter_covariance(tool).diagonal() + open_directions.square().sum(1)
    number, axis = divmod(int(variances.argmax()), 3)
    far = rough_millimetres(expected.error.whole)
    far = f"Use the model near the measured poses: elsewhere errors of {far} mm are expected"
    if found.share_of_tool > BLAMED_VARIANCE_SHARE or bool((open_directions.abs() > OPEN_M).any()):
        what = model.bodies.name(number, len(found.rows.on))
        along = f"along {'xyz'[axis]} of {printable(found.rows.on[number])}"
        yield (
            f"{far}, because {what} and base can hardly be told apart {along}. To change that, measure poses in which "
            "the tool is turned about other axes, such as those listed under Where."
        )
    else:
        yield f"{far}. To change that, measure poses unlike them, such as those listed under Where."


def still_joints(found: PositionFindings) -> Iterator[str]:
    """A sentence about joints that never moved in the fit: their errors are not known."""
    q, robot = found.rows.q, found.model.robot
    for joint, name in enumerate(robot.joint_names):
        if float(q[:, joint].max() - q[:, joint].min()) < STILL_RANGE:
            place, unit = float(joint_values(robot, joint, q[:, joint]).mean()), "deg"
            unit = "mm" if robot.kinds[joint] == "prismatic" else unit
            yield (
                f"{printable(name)} never moved in the fit: nothing is known about it away from {place:.1f} {unit}. "
                "Measure poses in which it moves."
            )


def worst_range(found: PositionFindings) -> Iterator[str]:
    """A sentence about the part of a joint's range with the largest errors, if they are unusual."""
    seen, robot = found.predictions, found.model.robot
    lengths, worst = 1e3 * largest_known(seen.errors.errors), (BAD_RATIO * 1e3 * seen.errors.rms, "")
    for joint, name in enumerate(robot.joint_names):
        values = joint_values(robot, joint, seen.data.q[:, joint])
        middles, groups = in_bins(values, lengths)
        half = 0.5 * (middles[1] - middles[0])
        unit = "mm" if robot.kinds[joint] == "prismatic" else "deg"
        for middle, group in zip(middles, groups, strict=True):
            rms = float(group.square().mean().sqrt())
            if rms > worst[0]:
                low, high = middle - half, middle + half
                where = f"{name} between {low:.0f} and {high:.0f} {unit} ({len(group)} rows)"
                worst = (rms, f"The largest errors are found with {where}: {rms:.3f} mm RMS.")
    if worst[1]:
        yield worst[1]


def judged(found: PositionFindings) -> str:
    """Whether the claimed regions can be believed, as far as the number of rows tells."""
    inside, count = found.predictions.inside()
    low, high = binomial_band(count, 0.95, MISCALIBRATION_PROBABILITY)
    if inside < low:
        what = "these are too small: widen the model's deviations, or measure more poses like these"
    elif inside > high:
        what = "these are cautious"
    else:
        what = "these, which contain the noise of a measurement, agree with that for poses like the ones shown"
    hold = f"{low} to {high}" if low < high else f"all {high}"
    return (
        f"{inside} of {count} errors lie in the regions that claim 95 %. Of {count} errors, regions of the right size "
        f"hold {hold} in nine cases of ten; {what}."
    )
