"""The sections of a report: what each shows, in words, tables and pictures."""

from __future__ import annotations

import torch

from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.gear_lines import gear_lines
from diffeo_calib.kinematics.laden_rows import at_payloads
from diffeo_calib.measurements.pose_frames import middles
from diffeo_calib.reports.analysis.findings import Findings
from diffeo_calib.reports.analysis.fit_rows import FitRows
from diffeo_calib.reports.html import sentences
from diffeo_calib.reports.html.document import Scene, Section, Table
from diffeo_calib.reports.html.pieces import joint_values_by_row, listed, millimetres, panel, rough_millimetres
from diffeo_calib.reports.plots.errors import draw_before_after, draw_distributions
from diffeo_calib.reports.plots.joints import (
    PART_WIDTH,
    draw_expected,
    draw_parts,
    draw_transmission,
    short,
)
from diffeo_calib.reports.plots.style import PANEL, Frame

UNDER_LEGEND = Frame((PANEL[0], PANEL[1] + 0.5), top=0.8)
"""Panels with a legend or title of several lines above them."""
PER_LETTER = 0.066
"""Width of a letter of a panel, inches."""
OPEN_SHARE = 0.8
"""Share of the prior deviation above which a correction is open."""
MOST_POINTS = 600
"""Places of the scene."""
DIGITS = 5
"""Decimals of a length in m that a scene needs: 10 um at 1 m."""


def how_good(found: Findings) -> Section:
    """Errors by stage."""
    some = next(iter(found.errors.values()))
    pictures = [
        panel(
            "distributions",
            "Share of poses whose position error is at most a value.",
            draw_distributions,
            found.errors,
            repeatability=None if found.repeats is None else found.repeats.deviation,
            frame=UNDER_LEGEND,
        )
    ]
    pictures.append(
        panel(
            "before-after",
            "Every pose: error of the calibrated model against that of the stage before it.",
            draw_before_after,
            found.errors,
            frame=UNDER_LEGEND,
        )
    )
    if some.angles is not None:
        label = "Share of poses whose orientation error is at most a value."
        pictures.append(panel("angles", label, draw_distributions, found.errors, angles=True, frame=UNDER_LEGEND))
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
    return Section("errors", "How good", see, [_by_stage(found)], None, pictures, notes)


def _by_stage(found: Findings) -> Table:
    """Position errors of each stage in mm, and orientation errors in degrees if there are any."""
    some = next(iter(found.errors.values()))
    header = ["stage", "RMS [mm]", "median", "95 %", "max"]
    header += ["RMS [deg]", "median", "95 %", "max"] * (some.angles is not None)
    rows = []
    for name, errors in found.errors.items():
        cells = [millimetres(errors.rms), millimetres(errors.median), millimetres(errors.p95), millimetres(errors.max)]
        angles = (errors.angle_rms, errors.angle_median, errors.angle_p95, errors.angle_max)
        rows.append([name, *cells, *(f"{angle:.4f}" for angle in angles if angle is not None)])
    return Table("Position errors by stage", header, rows)


def where(found: Findings) -> Section:
    """The workspace in space, and expected errors against every joint."""
    robot, expected = found.model.robot, found.expected
    pictures = [
        panel(
            f"expected-{joint}",
            f"Error that the model itself expects against {name}: dashed anywhere in the measured ranges, solid where "
            "it was measured.",
            draw_expected,
            robot,
            joint,
            expected,
            key=joint == 0,
        )
        for joint, name in enumerate(robot.joint_names)
    ]
    q = expected.next.q[expected.next.rank.argsort()]
    table = Table(
        f"Where to measure next: {len(q)} poses that would lower the expected error most",
        ["rank", *(str(rank) for rank in range(1, len(q) + 1))],
        joint_values_by_row(robot, q),
    )
    see = (
        "Arrows point from the predicted to the measured place, with one scale in all views. Below, the error that the "
        f"model itself expects, without the noise of a measurement: {rough_millimetres(expected.measured_rms)} mm RMS "
        f"at the measured configurations, {rough_millimetres(expected.rms)} mm anywhere in the measured joint ranges."
    )
    notes = [*sentences.unlike_poses(found), *sentences.worst_range(found)]
    then = rough_millimetres(float(expected.next.expected_rms[-1]))
    notes.append(
        f"After the {len(q)} poses to measure next the model expects {then} mm anywhere in the "
        "ranges. Check them in the robot's cell before you move there."
    )
    return Section("where", "Where", see, [table], _scene(found), pictures, notes)


def _scene(found: Findings) -> Scene:
    seen = found.predictions
    there = ~seen.measured.isnan().any(2)  # of the sightings
    step, errors = -(-int(there.sum()) // MOST_POINTS), {}
    *before, (last, _) = found.stages.items()
    for name, kinematics in before:
        predicted = at_payloads(kinematics, seen.data)(seen.data.q).detach()
        if seen.data.poses is not None:
            predicted = middles(predicted)
        errors[name] = listed((seen.measured - predicted)[there][::step], DIGITS + 2)
    errors[last] = listed(seen.away[there][::step], DIGITS + 2)
    return Scene(listed(seen.measured[there][::step], DIGITS), errors)


def why(found: Findings) -> Section:
    """Transmission errors, parts, geometry corrections."""
    robot = found.model.robot
    longest = max(len(short(part.name)) for part in found.parts)
    pictures = [
        panel(
            "parts",
            "What each part of the model explains (parts may cancel).",
            draw_parts,
            found.parts,
            frame=Frame((PART_WIDTH, 0.9 + 0.24 * len(found.parts)), left=0.3 + PER_LETTER * longest),
        )
    ]
    for joint, name in enumerate(robot.joint_names):
        pictures.append(
            panel(
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
        f"Gravity sag is elastic: {_payload(found.model)}. Coupled joint errors depend on several "
        "joints, task space on the place of the marker. Corrections are open where the rows do not tell them; "
        "corrections about or along parallel axes stand for one another."
    ]
    notes += [f"{line.sentence}, not in the pictures above." for line in gear_lines(found.model)]
    return Section("why", "Why", see, [_corrections(found.model, found.rows)], None, pictures, notes)


def _payload(model: CalibratedKinematics) -> str:
    known = model.nominal.payload
    if known is None or model.payload is None:
        return "the model holds for the payload of the fit"
    return f"payloads up to {known.unit:g} are part of the model, and the pictures are for {model.payload:g}"


def _corrections(model: CalibratedKinematics, fit_rows: FitRows) -> Table:
    """Error twists of the joints in the model's geometry, with deviations."""
    nominal = model.nominal
    joints = nominal.geometry.slices["joints"]
    found = nominal.split(model.map.deformation.momenta.theta)[0][joints].view(-1, 6)
    numbers = torch.arange(nominal.geometry.size, device=found.device)[joints]
    claimed = fit_rows.map.parameter_covariance(numbers).diagonal().sqrt().view(-1, 6)
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
