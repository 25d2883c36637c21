"""The sections of a report: what each shows, in words, tables and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.findings import Outlier
from diffeo_calib.common.errors import printable
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.reports.analysis.findings import Findings
from diffeo_calib.reports.analysis.fit_rows import FitRows
from diffeo_calib.reports.analysis.repeats import STANDARD_REPEATS
from diffeo_calib.reports.html import sentences
from diffeo_calib.reports.html.document import Picture, Scene, Section, Table
from diffeo_calib.reports.html.svg import picture
from diffeo_calib.reports.plots.errors import draw_before_after, draw_distributions
from diffeo_calib.reports.plots.joints import (
    PART_WIDTH,
    draw_expected,
    draw_parts,
    draw_transmission,
    joint_label,
    joint_values,
)
from diffeo_calib.reports.plots.style import FRAME, PANEL, Frame, single_panel
from diffeo_calib.reports.plots.trust import draw_coverage, draw_learning_curve, draw_residuals

UNDER_LEGEND = Frame((PANEL[0], PANEL[1] + 0.5), top=0.8)
"""Panels with a legend or title of several lines above them."""
PER_LETTER = 0.066
"""Width of a letter of a panel, inches."""
OPEN_SHARE = 0.8
"""Share of the prior deviation above which a correction is open."""
LARGEST = 5
"""Rows with the largest errors that are listed."""
MOST_OUTLIERS = 20
"""Rows that look wrong that are listed."""
MOST_POINTS = 600
"""Places of the scene."""
MOST_REPEATS = 12
"""Repeated poses that are listed."""
DIGITS = 5
"""Decimals of a length in m that a scene needs: 10 um at 1 m."""


def how_good(found: Findings) -> Section:
    """Errors by stage."""
    some = next(iter(found.errors.values()))
    header = ["stage", "RMS [mm]", "median", "95 %", "max"]
    header += ["RMS [deg]", "median", "95 %", "max"] * (some.angles is not None)
    rows = []
    for name, errors in found.errors.items():
        cells = [_mm(errors.rms), _mm(errors.median), _mm(errors.p95), _mm(errors.max)]
        angles = (errors.angle_rms, errors.angle_median, errors.angle_p95, errors.angle_max)
        rows.append([name, *cells, *(f"{angle:.4f}" for angle in angles if angle is not None)])
    pictures = [
        _panel(
            "distributions",
            "Share of poses whose position error is at most a value.",
            draw_distributions,
            found.errors,
            repeatability=None if found.repeats is None else found.repeats.deviation,
            frame=UNDER_LEGEND,
        )
    ]
    pictures.append(
        _panel(
            "before-after",
            "Every pose: error of the calibrated model against that of the stage before it.",
            draw_before_after,
            found.errors,
            frame=UNDER_LEGEND,
        )
    )
    if some.angles is not None:
        label = "Share of poses whose orientation error is at most a value."
        pictures.append(_panel("angles", label, draw_distributions, found.errors, angles=True, frame=UNDER_LEGEND))
    see = f"Errors on {sentences.rows_of(found)}: each stage should lie well to the left of the one before it."
    notes = [
        "Nominal: the robot's description, placed where it fits best. Geometric: joint axes and links corrected, the "
        "classical calibration. Calibrated: gravity sag, transmission errors and what is left as well."
    ]
    if found.predictions.left_out:
        notes.append(
            "Nominal and geometric kinematics were fitted to these poses too, with so few parameters that it hardly "
            "matters. Measurements of new poses (--data) are the stronger proof."
        )
    return Section("errors", "How good", see, [Table("Position errors by stage", header, rows)], None, pictures, notes)


def where(found: Findings) -> Section:
    """The workspace in space, and expected errors against every joint."""
    robot, expected = found.model.robot, found.expected
    pictures = [
        _panel(
            f"expected-{joint}",
            f"Error that the model itself expects against {name}, over the measured joint ranges.",
            draw_expected,
            robot,
            joint,
            expected,
        )
        for joint, name in enumerate(robot.joint_names)
    ]
    header = ["rank", *(joint_label(robot, joint) for joint in range(robot.n))]
    order = expected.next.rank.argsort()
    q = expected.next.q[order]
    cells = [[f"{float(joint_values(robot, joint, row)[joint]):.1f}" for joint in range(robot.n)] for row in q]
    table = Table(
        f"Where to measure next: {len(q)} poses that would lower the expected error most",
        header,
        [[str(rank), *values] for rank, values in enumerate(cells, 1)],
    )
    see = (
        "Arrows point from the predicted to the measured place, with one scale in all views. Below, the error that the "
        f"model itself expects, without the noise of a measurement: {_mm(expected.measured_rms)} mm RMS in "
        f"configurations like the measured ones, {_mm(expected.rms)} mm anywhere in the measured joint ranges."
    )
    notes = [*sentences.unlike_poses(found), *sentences.worst_range(found)]
    notes.append(
        f"After the {len(q)} poses to measure next the model expects {_mm(float(expected.next.expected_rms[-1]))} mm "
        f"instead of {_mm(float(expected.next.expected_rms[0]))} mm anywhere in the ranges. Check them in the robot's "
        "cell before you move there."
    )
    return Section("where", "Where", see, [table], _scene(found), pictures, notes)


def _scene(found: Findings) -> Scene:
    seen = found.predictions
    step = -(-len(seen) * seen.measured.shape[1] // MOST_POINTS)
    errors = {}
    *before, (last, _) = found.stages.items()
    for name, kinematics in before:
        predicted = kinematics(seen.data.q).detach()
        if seen.data.poses is not None:
            predicted = predicted.mean(1, keepdim=True)
        errors[name] = _listed((seen.measured - predicted).flatten(0, 1)[::step], DIGITS + 2)
    errors[last] = _listed(seen.away.flatten(0, 1)[::step], DIGITS + 2)
    return Scene(_listed(seen.measured.flatten(0, 1)[::step], DIGITS), errors)


def why(found: Findings) -> Section:
    """Transmission errors, parts, geometry corrections."""
    robot = found.model.robot
    longest = max(len(part.name) for part in found.parts)
    pictures = [
        _panel(
            "parts",
            "What each part of the model explains (parts may cancel).",
            draw_parts,
            found.parts,
            frame=Frame((PART_WIDTH, 0.9 + 0.24 * len(found.parts)), left=0.3 + PER_LETTER * longest),
        )
    ]
    for joint, name in enumerate(robot.joint_names):
        pictures.append(
            _panel(
                f"transmission-{joint}",
                f"{name}: motion beyond its reading, with its 95 % band; below, where the joint was measured.",
                draw_transmission,
                found.model,
                found.rows,
                joint,
            )
        )
    see = (
        "A wave of one period per turn is eccentricity of a gear or an encoder, of two its ovality, faster ones are "
        "meshing; a wide band means that the joint was measured too little there."
    )
    notes = [
        "Gravity sag is elastic: the model holds for the payload of the fit. Coupled joint errors depend on several "
        "joints, task space on the place of the marker. Corrections are open where the rows do not tell them; "
        "corrections about or along parallel axes stand for one another."
    ]
    return Section("why", "Why", see, [_corrections(found.model, found.rows)], None, pictures, notes)


def _corrections(model: CalibratedKinematics, fit_rows: FitRows) -> Table:
    """Error twists of the joints in the model's geometry, with deviations."""
    nominal = model.nominal
    joints = nominal.geometry.slices["joints"]
    found = nominal.split(model.map.deformation.momenta.theta)[0][joints].view(-1, 6)
    numbers = torch.arange(nominal.geometry.size, device=found.device)[joints]
    claimed = fit_rows.map.parameter_variances(numbers).sqrt().view(-1, 6)
    prior = model.map.geodesic.spec.prior_variance[: nominal.geometry.size][joints].sqrt().view(-1, 6)
    rows = [
        [name, *(_correction(*entry) for entry in zip(*(values.tolist() for values in entries), strict=True))]
        for name, *entries in zip(model.robot.moving_names, found, claimed, prior, strict=True)
    ]
    header = ["before joint", *(f"{axis} [mm]" for axis in "xyz"), *(f"r{axis} [mrad]" for axis in "xyz")]
    return Table("Geometry corrections with their standard deviations", header, rows)


def _correction(value: float, deviation: float, prior: float) -> str:
    """A correction in mm or mrad with its deviation; "open" if the rows hardly lower that of the prior."""
    if deviation > OPEN_SHARE * prior and abs(value) < deviation:
        return "open"
    return f"{1e3 * value:.3f} \u00b1 {1e3 * deviation:.3f}"


def trust(found: Findings) -> Section:
    """Claimed against found errors, residuals, outliers, learning curve."""
    seen, robot = found.predictions, found.model.robot
    pictures = [
        _panel(
            "coverage",
            "Found against claimed shares of errors; on the diagonal the claims are true.",
            draw_coverage,
            seen,
        ),
    ]
    if found.learning_curve:
        pictures.append(
            _panel(
                "learning",
                "Error of rows of the fit when a model knows fewer of them, each row left out in turn.",
                draw_learning_curve,
                found.learning_curve,
                found.forecast,
                found.limit if found.repeats else None,
            )
        )
    columns = {"row": seen.data.line_numbers.double(), **found.columns}
    for number, (name, values) in enumerate(columns.items()):
        label = printable(name)
        pictures.append(
            _panel(
                f"residuals-{number}",
                f"Errors against {label}: a trend is a drift.",
                draw_residuals,
                values,
                seen,
                label,
            )
        )
    for joint, name in enumerate(robot.joint_names):
        values = joint_values(robot, joint, seen.data.q[:, joint])
        label = joint_label(robot, joint)
        pictures.append(
            _panel(
                f"residuals-joint-{joint}",
                f"Errors against {name}.",
                draw_residuals,
                values,
                seen,
                label,
            )
        )
    share = 100 * seen.coverage()
    see = f"{share:.0f} % of the errors lie in the regions that claim 95 %. {sentences.judged(found)}"
    tables = [_outliers(found.outliers)] if found.outliers else []
    tables.append(_largest(found))
    notes = list(found.moved) or ["No device or marker moved, and no block of rows is wrong."]
    if not found.outliers:
        notes.append(
            "No row looks wrong: none is further from its prediction than chance allows in a table of this size (1 %), "
            "by the model's own deviations."
        )
    return Section("trust", "Can I trust it", see, tables, None, pictures, notes)


def _largest(found: Findings) -> Table:
    """The rows with the largest errors, beside what the model expects there."""
    seen, robot = found.predictions, found.model.robot
    errors, body = seen.errors.errors.max(1)
    order = errors.argsort(descending=True)[:LARGEST].tolist()
    rows = [
        [
            str(int(seen.data.line_numbers[row])),
            _mm(float(errors[row])),
            _mm(float(seen.claimed[row, body[row]])),
            *(f"{float(joint_values(robot, joint, seen.data.q[row])[joint]):.1f}" for joint in range(robot.n)),
        ]
        for row in order
    ]
    header = ["row", "error [mm]", "expected RMS", *(joint_label(robot, joint) for joint in range(robot.n))]
    return Table("Largest errors, and what the model expects of a measurement there", header, rows)


def _outliers(outliers: Sequence[Outlier]) -> Table:
    rows = [
        [str(one.number), "" if one.marker is None else str(one.marker), _mm(one.distance), one.reason]
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
            _mm(float(rp)),
            *(_mm(float(repeats.accuracy[name][k])) for name in names),
        ]
        for k, (line, count, rp) in enumerate(zip(repeats.lines, repeats.counts, repeats.repeatability, strict=True))
    ][:MOST_REPEATS]
    worst = ["worst", "", _mm(float(repeats.repeatability.max()))]
    mean = ["mean", "", _mm(float(repeats.repeatability.mean()))]
    for name in names:
        worst.append(_mm(float(repeats.accuracy[name].max())))
        mean.append(_mm(float(repeats.accuracy[name].mean())))
    see = (
        f"{len(repeats.counts)} poses were measured several times: single measurements are {_mm(repeats.deviation)} mm "
        "RMS away from their mean, which limits the RMS error of any model."
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


def _panel(name: str, label: str, draw: Callable[..., None], *what: Any, frame: Frame = FRAME, **how: Any) -> Picture:
    """A picture of one panel, drawn by ``draw(axes, *what, **how)``."""
    figure, axes = single_panel(frame)
    draw(axes, *what, **how)
    return picture(figure, name, label)


def _listed(values: Tensor, digits: int) -> list[list[float]]:
    return [[round(value, digits) for value in row] for row in values.tolist()]


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3f}"
