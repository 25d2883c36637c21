"""The sections of a report, in words, tables and pictures; its verdict and advice; and how the model was made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.judged_rows import outlier_lines
from diffeo_calib.common.errors import PACKAGE, printable
from diffeo_calib.common.quantiles import binomial_band, largest_known
from diffeo_calib.kinematics.calibrated import CalibratedKinematics, measured_words
from diffeo_calib.kinematics.evaluation import at_payloads
from diffeo_calib.kinematics.hand_eye import HandEye, hand_eye_sentences
from diffeo_calib.kinematics.transmission import gear_lines
from diffeo_calib.measurements.bodies import placement_lines
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.reports.analysis.findings import STANDARD_REPEATS, Findings, Kinematics, RowsOfKind
from diffeo_calib.reports.analysis.predictions import FitRows, Predictions
from diffeo_calib.reports.html.document import Picture, Section, Table, joint_values_by_row, rough_millimetres
from diffeo_calib.reports.html.document import millimetres as mm
from diffeo_calib.reports.html.document import rough_millimetres as rough
from diffeo_calib.reports.plots import panels
from diffeo_calib.reports.plots.panels import PANEL, Frame, in_bins, joint_label, joint_unit, joint_values
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.payload import payload_sentence
from diffeo_calib.sensors.errors import ERRORS, SIZES, Evaluation

UNDER_LEGEND = Frame((PANEL[0], PANEL[1] + 0.5), top=0.8)  # panels with a legend or title of several lines above them
FLATTERING = {
    "spread": "A spread within sockets is no error: what all rows of a socket share does not show in it.",
    "readings": "Errors of readings do not show what no reading sees, such as the robot's size with heights.",
}
PER_LETTER = 0.066  # width of a letter of a panel, inches
OPEN_SHARE = 0.8  # share of the prior deviation above which a correction is open
MOST_POINTS = 600  # places of the scene
SCENE_DECIMALS = 5  # decimals of a length in m that a scene needs: 10 um at 1 m


def stage_pictures(stages: Mapping[str, Evaluation], suffix: str, repeatability: float | None) -> Iterator[Picture]:
    """Errors of one kind of rows by stage; ``suffix`` tells the pictures of several kinds apart."""
    some = next(iter(stages.values()))
    label = f"Share of rows whose {some.label} is at most a value."
    how = {"repeatability": repeatability, "frame": UNDER_LEGEND}
    yield Picture(f"distributions{suffix}", label, panels.draw_distributions, stages, **how)
    label = f"Every row: {some.label} of the calibrated model against that of the stage before it."
    yield Picture(f"before-after{suffix}", label, panels.draw_before_after, stages, frame=UNDER_LEGEND)
    turned = {name: stage.orientation for name, stage in stages.items() if stage.orientation is not None}
    if turned:
        label = "Share of rows whose orientation error is at most a value."
        yield Picture(f"angles{suffix}", label, panels.draw_distributions, turned, frame=UNDER_LEGEND)


def stage_table(stages: Mapping[str, Evaluation]) -> Table:
    """Errors of one kind of rows by stage, and orientation errors in degrees if there are any."""
    some = next(iter(stages.values()))
    units = [errors.shown[0] for errors in some.each]
    header = ["stage", *(name for unit in units for name in (f"{SIZES[0]} [{unit}]", *SIZES[1:]))]
    rows = [
        [name, *(f"{size:.{3 + number}f}" for number, errors in enumerate(stage.each) for size in errors.sizes)]
        for name, stage in stages.items()
    ]
    return Table(f"{some.title} by stage", header, rows)


def sections(findings: Findings) -> Iterator[Section]:
    """Contents of the page before its record."""
    yield from (section(findings) for section in (how_good, where, why, trust, repeatability))
    if findings.devices:
        see = "Where devices and sockets stand, and what was found from the rows shown as the model did not know it."
        yield Section("devices", "Devices", see, text=[printable(line) for line in findings.devices])


def how_good(findings: Findings) -> Section:
    """Errors of every kind of rows by stage."""
    limit = None if findings.repeats is None else findings.repeats.deviation
    pictures = list[Picture]()
    for number, kind in enumerate(findings.kinds.values()):
        pictures += stage_pictures(kind.stages, f"-{number}", limit if kind.errors.what == ERRORS else None)
    see = f"Errors on {rows_of(findings)}: each stage should lie well to the left of the one before it."
    see += " Each kind has its own unit; units are never mixed." * (len(findings.kinds) > 1)
    see = see if findings.kinds else "No rows were passed: pass some to see errors of each kind in its own unit."
    notes = [
        "Nominal: the robot's description, placed where it fits best. Geometric: joint axes and links corrected, the "
        "classical calibration. Calibrated: gravity sag, transmission errors and remaining errors as well."
    ]
    present = {kind.errors.what for kind in findings.kinds.values()}
    notes += [text for what, text in FLATTERING.items() if what in present]
    if findings.kinds and not findings.new:
        notes.append(
            "Nominal and geometric kinematics were fitted to these poses too, with so few parameters that it hardly "
            "matters. Measurements of new poses are the stronger proof."
        )
    tables = [stage_table(kind.stages) for kind in findings.kinds.values()]
    return Section("errors", "How good", see, tables, None, pictures, notes)


def where(findings: Findings) -> Section:
    """What the model expects of its positions, by stage and against every joint; the poses to measure next."""
    robot, error, plan = findings.model.robot, findings.deviations.error, findings.deviations.next
    pictures, solid = list[Picture](), "dashed anywhere in the measured ranges, solid where it was measured."
    for k, name in enumerate(robot.joint_names):
        label, what = f"Error that the model itself expects against {printable(name)}: {solid}", (robot, k)
        pictures.append(Picture(f"expected-{k}", label, panels.draw_expected, *what, findings.deviations, key=k == 0))
    scene = None if findings.predictions is None else _scene(findings.stages, findings.predictions)
    arrows = "Arrows point from the predicted to the measured place, with one scale in all views. Below: "
    see = arrows * (scene is not None) + (
        "The error that the model itself expects, without the noise of a measurement: "
        f"{rough(error.measured)} mm RMS at the measured configurations; anywhere in the measured joint "
        f"ranges {printable(error.sentence)}"
    )
    if findings.model.own_frame:
        see += ", after a rigid fit, because no device says where the robot stands"
    rows = [[name, mm(value)] for name, value in findings.expected.items()]
    tables = [Table("Expected error of positions by stage", ["stage", "RMS [mm]"], rows)]
    notes = [*unlike_poses(findings), *worst_range(findings)]
    if plan is not None:
        q, then = plan.q[plan.rank.argsort()], rough(float(plan.expected_rms[-1]))
        caption = f"Where to measure next: {len(q)} poses that would lower the expected error most"
        ranks = ["rank", *(str(rank) for rank in range(1, len(q) + 1))]
        tables.append(Table(caption, ranks, joint_values_by_row(robot, q)))
        after = f"After the {len(q)} poses to measure next the model expects {then} mm anywhere in the ranges"
        notes.append(f"{after}. Check them in the robot's cell before you move there.")
    return Section("where", "Where", f"{see}.", tables, scene, pictures, notes)


def _scene(stages: Mapping[str, Kinematics], rows: Predictions) -> dict[str, Any]:
    there = ~rows.measured.isnan().any(2)  # of the sightings
    step, errors = -(-int(there.sum()) // MOST_POINTS), dict[str, list[list[float]]]()

    def listed(values: Tensor, digits: int) -> list[list[float]]:
        return [[round(value, digits) for value in row] for row in values[there][::step].tolist()]

    for number, (name, kinematics) in enumerate(stages.items(), 1):
        origins = rows.predicted  # of the model, which has not seen the rows
        if number < len(stages):
            origins = rows.data.bodies.origins(at_payloads(kinematics, rows.data)(rows.data.q).detach())
        errors[name] = listed(rows.measured - origins, SCENE_DECIMALS + 2)
    return {"points": listed(rows.measured, SCENE_DECIMALS), "errors": errors}


def why(findings: Findings) -> Section:
    """What each part of the model explains: sag, waves of its gears, and corrections of the geometry."""
    parts = findings.parts
    left = 0.3 + PER_LETTER * max(len(panels.short(part.name)) for part in parts)
    frame = Frame((panels.PART_WIDTH, 0.9 + 0.24 * len(parts)), left=left)
    label = "What each part of the model explains (parts may cancel)."
    pictures = [Picture("parts", label, panels.draw_parts, parts, frame=frame)]
    label = "motion beyond its reading, with its 95 % band; below, where the joint was measured."
    for joint, name in enumerate(findings.model.robot.joint_names):
        what = panels.draw_transmission, findings.model, findings.rows, joint
        pictures.append(Picture(f"transmission-{joint}", f"{printable(name)}: {label}", *what))
    see, tables = "A wide band means that the joint was measured too little there.", list[Table]()
    notes = ["Coupled joint errors depend on several joints, task space on the place of the marker."]
    if not is_cartesian(findings.model.robot):  # whose joints have no links, gears and weight
        waves = "A wave of one period per turn is eccentricity of a gear or an encoder, of two its ovality"
        see, tables = f"{waves}, faster ones are meshing. {see}", [_corrections(findings.model, findings.rows)]
        notes.insert(0, f"Gravity sag is elastic: {payload_sentence(findings.model.nominal.load)}.")
        notes += [f"{line.sentence}, not in the pictures above." for line in gear_lines(findings.model)]
        notes.append(
            "Corrections are open where the rows do not tell them; those of parallel axes stand for one another."
        )
    return Section("why", "Why", see, tables, None, pictures, notes)


def _corrections(model: CalibratedKinematics, fit_rows: FitRows) -> Table:
    """Error twists of the joints in the model's geometry, with deviations in mm or mrad.

    Those are "open" whose deviation the rows hardly lower from that of the prior.
    """
    nominal = model.nominal
    which = nominal.geometry.slices["joints"]
    theta, numbers = model.map.deformation.momenta.theta, torch.arange(nominal.geometry.size, device=fit_rows.q.device)
    claimed = fit_rows.map.parameter_covariance(numbers[which]).diagonal().sqrt()
    prior = model.map.geodesic.spec.prior_variance[: nominal.geometry.size][which].sqrt()
    rows = [[name] for name in model.robot.moving_names]
    entries = zip(*(each.tolist() for each in (nominal.split(theta)[0][which], claimed, prior)), strict=True)
    for number, (value, deviation, before) in enumerate(entries):
        sure = deviation <= OPEN_SHARE * before or abs(value) >= deviation
        rows[number // 6].append(f"{1e3 * value:.3f} \u00b1 {1e3 * deviation:.3f}" if sure else "open")
    header = ["before joint", *(f"{axis} [mm]" for axis in "xyz"), *(f"r{axis} [mrad]" for axis in "xyz")]
    return Table("Geometry corrections with their standard deviations", header, rows)


LISTED_ROWS = 5  # rows with the largest errors that are listed
MOST_REPEATS = 12  # repeated poses that are listed


def trust(findings: Findings) -> Section:
    """Claimed against found errors, residuals, outliers, learning curve."""
    registered, rows = findings.model.registration, findings.predictions
    tables = [_largest(findings, kind) for kind in findings.kinds.values()]
    notes = list(findings.moved)
    if registered is not None:
        each = f"each predicted by the others {mm(registered.left_out_rms)} mm"
        after = f"{registered.rows} rows, RMS {mm(registered.rms_after)} mm"
        notes.append(f"The model was registered anew with {after}; {each}.")
    elif not notes and rows is not None:
        notes.append("No device or marker moved, and no block of rows is wrong.")
    if not findings.outliers and not findings.moved and rows is not None:
        none = "No row looks wrong: none is further from its prediction than chance allows in a table of this size"
        notes.append(f"{none} (1 %), by the model's own deviations.")
    pictures = list[Picture]()
    if rows is not None:
        label = "Found against claimed shares of errors; on the diagonal the claims are true."
        pictures.append(Picture("coverage", label, panels.draw_coverage, rows))
    if findings.learning_curve:
        label = "Error of rows of the fit when a model knows fewer of them, each row left out in turn."
        what = findings.learning_curve, findings.forecast, findings.limit if findings.repeats else None
        pictures.append(Picture("learning", label, panels.draw_learning_curve, *what))
    pictures += _residuals(findings)
    wrong = list(outlier_lines(findings.outliers, 0 if rows is None else len(rows), "rows"))
    return Section("trust", "Can I trust it", judged(findings), tables, None, pictures, notes, wrong)


def _residuals(findings: Findings) -> Iterator[Picture]:
    robot = findings.model.robot
    for place, kind in enumerate(findings.kinds.values()):
        errors, q = kind.errors, kind.q
        what = errors.title if len(findings.kinds) > 1 else "Errors"
        columns = {"row": kind.lines.double(), **(findings.columns if errors.what == ERRORS else {})}
        for number, (name, values) in enumerate(columns.items()):
            label = f"{what} against {printable(name)}, their RMS dashed: a trend is a drift."
            missing = int((~values.isfinite()).sum())
            label += f" {missing} of {len(values)} rows have no value." * (missing > 0)
            given = values, errors, printable(name)
            yield Picture(f"residuals-{place}-{number}", label, panels.draw_residuals, *given, key=number == 0)
        for joint, name in enumerate(robot.joint_names):
            label = f"{what} against {printable(name)}, their RMS dashed."
            given = joint_values(robot, joint, q[:, joint]), errors, joint_label(robot, joint)
            yield Picture(f"residuals-{place}-joint-{joint}", label, panels.draw_residuals, *given, key=False)


def _largest(findings: Findings, kind: RowsOfKind) -> Table:
    """The rows of one kind with the largest errors, of positions beside what the model expects there."""
    (unit, per_unit), rows = kind.errors.shown, findings.predictions
    errors, body = kind.errors.errors.nan_to_num(0.0).max(1)  # hidden markers have no error
    order = errors.argsort(descending=True)[:LISTED_ROWS].tolist()
    lines = [[f"error [{unit}]", *(f"{per_unit * float(errors[row]):.3f}" for row in order)]]
    what = f"Largest: {kind.errors.label}" if len(findings.kinds) > 1 else "Largest errors"
    if rows is not None and kind.errors.what == ERRORS and len(rows) == len(kind.lines):
        what += ", and what the model expects of a measurement there"
        lines.append(["expected RMS [mm]", *(mm(float(rows.claimed[row, body[row]])) for row in order)])
    lines += joint_values_by_row(findings.model.robot, kind.q[order])
    if kind.errors.errors.shape[1] > 1:
        on = [f" on {printable(tip)}" * (len({*findings.model.on}) > 1) for tip in findings.model.on]
        lines.insert(0, ["marker", *(f"{number}{on[number]}" for number in body[order].tolist())])
    return Table(what, ["row", *(str(int(kind.lines[row])) for row in order)], lines)


def repeatability(findings: Findings) -> Section:
    """Figures of ISO 9283, where poses were repeated."""
    repeats = findings.repeats
    if repeats is None:
        see = "No pose was measured twice: pose accuracy and repeatability (ISO 9283) cannot be told from these rows."
        note = "Repeat five poses, 30 times each, and pass the table."
        return Section("repeatability", "Repeatability", see, notes=[note])
    header = ["pose", "measured", "RP [mm]", *(f"AP {name} [mm]" for name in repeats.accuracy)]
    values = torch.stack([repeats.repeatability, *repeats.accuracy.values()], 1)  # (G, 1 + stages) m
    some = zip(repeats.lines.tolist(), repeats.counts.tolist(), values, strict=True)
    named = [(f"row {line}", str(count), spread) for line, count, spread in some][:MOST_REPEATS]
    named += [("worst", "", values.amax(0)), ("mean", "", values.mean(0))]
    rows = [[pose, count, *map(mm, spread.tolist())] for pose, count, spread in named]
    poses, away = f"{len(values)} poses were measured several times", f"{mm(repeats.deviation)} mm RMS away"
    see = f"{poses}: single measurements are {away} from their mean, which limits the RMS error of any model."
    few = f", from fewer than its {STANDARD_REPEATS} attainments" * (int(repeats.counts.min()) < STANDARD_REPEATS)
    note = (
        "As ISO 9283 defines them for positions: pose accuracy AP is the distance of the mean measured place from the "
        "commanded one, repeatability RP the mean distance of the measurements from their mean plus three standard "
        f"deviations of it{few}. Accuracy with the model is predicted: measure it again after the commands are "
        "corrected."
    )
    caption = "Pose accuracy (AP) and repeatability (RP)"
    caption += f", the first {MOST_REPEATS} poses" * (len(values) > MOST_REPEATS)
    return Section("repeatability", "Repeatability", see, [Table(caption, header, rows)], notes=[note])


def record(model: CalibratedKinematics, data_sha256: str | None) -> Section:
    """Everything needed to make the model again: when, how and of which table, robot, rows and ranges, how it ended."""
    made, robot, lines = model.provenance, model.robot, list[str]()
    if made is not None:
        lines.append(f"fitted        {made.date} (UTC) with {PACKAGE} {made.version}")
        lines += [f"command       {printable(made.command)}"] * bool(made.command)
        lines.append(f"table         sha256 {made.table_sha256}")
        lines += [f"note          {printable(made.note)}"] * bool(made.note)
    if data_sha256 is not None:
        same = made is not None and data_sha256 == made.table_sha256
        lines.append(f"data shown    {'the same table, rows of the fit left out' if same else 'sha256 ' + data_sha256}")
    lines.append(f"robot         {printable(robot.base)} to {printable(robot.tip)}, {robot.n} joints")
    lines.append(f"fitted to     {len(model.configurations)} rows, {measured_words(model)}")
    for joint, (name, values) in enumerate(zip(robot.joint_names, model.configurations.mT, strict=True)):
        low, high = (float(joint_values(robot, joint, end)) for end in values.aminmax())
        lines.append(f"  {printable(name)}: {low:.2f} to {high:.2f} {joint_unit(robot, joint)}")
    if (summary := model.summary) is not None:
        certificate = f"coupling {summary.coupling_residual:.1e}, end {summary.end_residual:.1e} (residuals)"
        if not (isfinite(summary.coupling_residual) and isfinite(summary.end_residual)):
            certificate = "without certificate: fewer control points than rows"
        lines.append(f"optimum       {certificate}")
        lines.append(f"status        {summary.status}; scales: {summary.scales}")
    lines += map(printable, placement_lines(model.geometry, poses=model.lever is not None, ball=model.ball))
    frames = [("robot base in the measuring frame", model.geometry.base), *model.bodies.frames(model.geometry)]
    for what, frame in frames:  # a thousandth of a degree is 50 um at 3 m
        numbers = *frame[:3, 3].tolist(), *rotation_numbers(frame[None, :3, :3], "rotvec")[0].tolist()
        lines.append(f"{printable(what)}, x y z rx ry rz [m, rad]: {' '.join(f'{number:.7f}' for number in numbers)}")
    lines += hand_eye_sentences(HandEye.of_fit(model))
    return Section("record", "Record", "Everything needed to make this model again.", text=lines)


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
