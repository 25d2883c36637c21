"""Rows that look wrong one by one: which of them chance does not explain, and their causes; devices and columns.

A column in which a device reports one value may be right: the height of a planar robot, the gauge of a ball that
touches a surface. It is wrong where the robot moves what the column tells, and the other rows contradict it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.identification.registration import spread
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MOST_NAMES, few, printable, sentence, warn_user
from diffeo_calib.common.quantiles import above_estimated, chi2_above, chi2_median, known, largest_known
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.rows import REPEAT_TOLERANCE
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.coordinates import errors_of_kinds

FAR = "far from where the other rows predict it"
MAX_MARKERS_FOR_EXCHANGE = 12
"""Number of markers up to which exchanged pairs are looked for."""
OF_DEVIATIONS = "std_"
"""Prefix of columns of known standard deviations, which may well be equal."""


@dataclass(frozen=True)
class Outlier:
    """A measurement that deviates from its prediction by more than noise explains.

    Args:
        row: number of the row in the measurements.
        marker: number of the marker; None if there is only one, or if poses were measured.
        tip: name of the tip, of poses on several; else None.
        number: line of the row in its file, see :attr:`Measurements.line_numbers`. name: of the row, in words.
        distance: from its prediction by all other rows, m; of readings in m at the tool.
        weight: its weight in the fit, about 1 for inliers; None if it took no part in the fit.
        reason: probable cause, in words.
        reading: what a reading is off by in its own unit, and this unit; None for measured positions.
    """

    row: int
    marker: int | None
    number: int
    name: str
    distance: float
    weight: float | None
    reason: str
    tip: str | None = None
    reading: tuple[float, str] | None = None

    @property
    def shown(self) -> tuple[float, str]:
        """Size of the error, and its unit."""
        return self.reading or (1e3 * self.distance, "mm")


MOST_OUTLIERS = 10
"""Most lines about single rows."""


def outlier_lines(outliers: Sequence[Outlier], rows: int, what: str = "training rows") -> Iterator[str]:
    """Sentences about rows that look wrong, the worst first; ``what`` the ``rows`` are."""
    flagged = len({outlier.row for outlier in outliers})
    for place, outlier in enumerate(outliers[:MOST_OUTLIERS]):
        if place == 0:
            kept = "" if outlier.weight is None else "; none was dropped"
            yield f"{flagged} of {rows} {what} look wrong (numbers are lines of the file){kept}:"
        marker = "" if outlier.marker is None else f", marker {outlier.marker}"
        marker = f", {printable(outlier.tip)}" if outlier.tip is not None else marker
        weight = "" if outlier.weight is None else f", weight {outlier.weight:.2g}"
        size, unit = outlier.shown
        yield f"  {printable(outlier.name)}{marker}: {size:.3f} {unit} off{weight}; {outlier.reason}"
    if len(outliers) > MOST_OUTLIERS:
        yield f"  and {len(outliers) - MOST_OUTLIERS} more"


def excluded(
    squares: Tensor, freedom: Tensor, *, least: float = 1.0, factor: float = 1.0, by_others: bool = True
) -> Tensor:
    """Which squared distances (N, bodies) are too large by chance, or beside most of the others.

    In units of a variance that is estimated from n numbers, the largest square of clean rows is that of an F ratio and
    not of chi-squared: twice as large with n = 30. Their median knows the variance half as well as all of them.

    Args:
        freedom: (N, bodies) of each. least: smallest size of the errors in units of what the model expects.
        factor: by which an error must exceed what chance explains. by_others: whether the others tell how large errors
            are, and not the model.
    """
    present, level = ~squares.isnan(), gates.OUTLIER_CHANCE / len(known(squares))
    kinds = freedom[present].unique().tolist()
    size = torch.cat([squares[present & (freedom == k)] / chi2_median(k) for k in kinds]).median()
    lower, limits = gates.MEDIAN_EFFICIENCY * float(freedom[present].sum()), torch.zeros_like(squares)
    for k in kinds:
        limits[freedom == k] = above_estimated(level, k, lower) if by_others else chi2_above(level, k)
    return squares > factor**2 * size.clamp(min=least) * limits


def outliers(
    model: CalibratedKinematics, placed: Any, tangent_data: TangentData, left_out: LeaveOneOut, least: float = 1.0
) -> list[Outlier]:
    """Measurements further from their prediction than noise explains, the worst first.

    Args:
        model: the calibrated model, which helps to find the causes.
        placed: the rows, as :func:`placing.place.place` finds them. tangent_data: the same, with their weights.
        left_out: their leave-one-out errors. least: see :func:`excluded`.
    """
    noise, weights, squares = tangent_data.noise_model, tangent_data.tails.weights, left_out.squares
    bad = excluded(squares, noise.of_freedom(float, squares), least=least)
    each = left_out.errors.unflatten(1, (noise.bodies, -1))
    distances = each.nan_to_num(0.0).norm(dim=2) if noise.size % 3 else each.unflatten(2, (-1, 3)).mean(2).norm(dim=2)
    outlying = []
    if placed.coordinates is not None:
        table, rows = placed.coordinates
        suspects = found_outliers(model, table, bad[rows], distances[rows], weights[rows])
        outlying += [replace(outlier, row=int(rows[outlier.row])) for outlier in suspects]
    for kind in placed.readings:
        sizes = each[kind.rows, 0].nan_to_num(0.0).norm(dim=1)
        shown = errors_of_kinds(left_out.errors, None, [kind]).main
        unit, per_unit = shown.shown
        for number in bad[kind.rows, 0].nonzero()[:, 0].tolist():
            row, line = int(kind.rows[number]), int(kind.data.line_numbers[number])
            reading, size = (per_unit * float(shown.errors[number, 0]), unit), float(sizes[number])
            name, weight = kind.data.row_names[number], float(weights[row, 0])
            outlying.append(Outlier(row, None, line, name, size, weight, FAR, reading=reading))
    return sorted(outlying, key=lambda outlier: -outlier.distance)


def contradicted(model: CalibratedKinematics, data: Measurements) -> list[Outlier]:
    """Measurements that took no part in a fit and that its model excludes, the worst first.

    Their distances are judged by the model's own deviations, or by the median distance if the model is overconfident.
    """
    predicted = data.bodies.predicted(model.at_payloads(data.payload), data.q)
    errors = data.bodies.errors(data, predicted.points)  # (N, bodies, 3 or 6) m and rad, NaN for hidden markers
    squares = (errors * torch.linalg.solve(predicted.covariance, errors[..., None])[..., 0]).sum(-1)
    freedom = torch.full_like(squares, errors.shape[-1])
    bad = excluded(squares, freedom, factor=gates.OVERCONFIDENT, by_others=False)
    return found_outliers(model, data, bad, errors[..., :3].norm(dim=-1))


def found_outliers(
    model: CalibratedKinematics, data: Measurements, bad: Tensor, distances: Tensor, weights: Tensor | None = None
) -> list[Outlier]:
    """Wrong measurements with their probable causes, the worst first.

    Args:
        model: the calibrated model. data: the measurements. bad: (N, bodies) which of them are wrong.
        distances: (N, bodies) from their predictions, m. weights: (N, bodies) in the fit, if they took part in it.
    """
    if not bool(bad.any()):
        return []
    labels = data.bodies.labels(data, model.on)
    data = data if labels[0][1] is None else data.with_tips([str(tip) for _, tip in labels])
    predicted, outlying, names = model.at_payloads(data.payload)(data.q).detach(), list[Outlier](), data.row_names
    for row, body in bad.nonzero().tolist():
        (marker, tip), weight = labels[body], None if weights is None else float(weights[row, body])
        reason, line = _reason(row, body, data, predicted, bad), int(data.line_numbers[row])
        outlying.append(Outlier(row, marker, line, names[row], float(distances[row, body]), weight, reason, tip))
    return sorted(outlying, key=lambda outlier: -outlier.distance)


def _reason(row: int, body: int, data: Measurements, predicted: Tensor, bad: Tensor) -> str:
    """Probable cause of an outlier, in words."""
    small = gates.REMAINING_ERROR * float(known((predicted[row] - data.points[row]).norm(dim=-1)).max())
    for other in data.bodies.exchangeable(data) if data.seen_bodies.shape[1] <= MAX_MARKERS_FOR_EXCHANGE else ():
        errors = (predicted[row, [body, other]] - data.points[row, [other, body]]).norm(dim=-1)
        if other != body and float(errors.max()) < small:
            return f"markers {body} and {other} seem to be exchanged"
    others = [k for k in range(bad.shape[1]) if k != body and bool(data.seen_bodies[row, k])]
    if others and not bool(bad[row, others].any()):
        return f"{data.body_names[body]} alone is off, the other {data.bodies.many} of this row fit"
    elsewhere = largest_known((predicted - data.points[row]).norm(dim=-1))
    elsewhere[row] = torch.inf
    nearest = int(elsewhere.argmin())
    if float(elsewhere[nearest]) < small:
        return f"fits the configuration of row {int(data.line_numbers[nearest])}: a wrong pairing?"
    repeats = ((data.q - data.q[row]).abs() <= REPEAT_TOLERANCE).all(1)
    repeats[row] = False
    if bool(repeats.any()) and not bool(bad[repeats].any()):
        return "repeated measurements of this pose agree with the model, so this one is probably wrong"
    return FAR


# --- devices and columns ---------------------------------------------------------------------------------------------


class DeviceRows(NamedTuple):
    """Rows of one kind that one device, or a device in one set-up, measured: its name, their numbers (M,), and they."""

    words: str
    rows: Tensor
    table: Any


def _device_rows(data: Any) -> Iterator[DeviceRows]:
    """The rows of any table by kind and device; those in sockets, of few rows each, together."""
    for part, numbers in zip(data.parts, data.index, strict=True):
        names = [name * (place < 0) for name, place in zip(part.device_names, part.places.tolist(), strict=True)]
        for name in dict.fromkeys(names):
            rows = [row for row, other in enumerate(names) if other == name]
            yield DeviceRows(f"{part.kind}s" + f" of '{name}'" * bool(name), numbers[rows], part.rows(rows))


def stuck_columns(data: Any) -> list[DeviceRows]:
    """Columns of any table in which a device reports one value in all rows where it reports any, and these rows."""
    stuck = list[DeviceRows]()
    for words, rows, table in _device_rows(data):
        for name, values in table.measured().items():
            if not isinstance(values, Tensor) or name.startswith(OF_DEVIATIONS):
                continue
            present = ~values.isnan()
            if int(present.sum()) >= gates.STUCK_ROWS and bool((values[present] == values[present][0]).all()):
                stuck.append(DeviceRows(f"'{name}' of the {words}", rows[present.to(rows.device)], table))
    return stuck


def _stuck_words(stuck: Sequence[DeviceRows]) -> str:
    several = len(stuck) > 1
    names = few([column.words for column in stuck], MOST_NAMES)
    return f"{names} hold{'s' * (not several)} one value in all of {'their' if several else 'its'} rows"


def warn_of_stuck(data: TangentData, table: Any) -> None:
    """Warn of columns of one value although the robot moves what they tell, by the geometric calibration."""
    size, bad = spread(data.points.unflatten(1, (-1, 3))), []
    for part in stuck_columns(table):
        rows, shape = part.rows.to(data.values.device), (data.noise_model.bodies, -1)
        values, visible = data.values[rows].unflatten(1, shape), data.visible[rows].unflatten(1, shape)  # (M, P, r) m
        bodies = [values[:, body, flags] for body, flags in enumerate(visible.all(0)) if bool(flags.any())]
        spreads = [float(torch.linalg.svdvals(body - body.mean(0))[-1]) for body in bodies]
        least = min(spreads, default=0.0) / len(rows) ** 0.5  # RMS motion along any direction, m
        bad += [(part, least)] if least > gates.GEOMETRIC_RESIDUAL * size else []
    if bad:
        expected = f"values that change by {1e3 * min(least for _, least in bad):.3g} mm or more, as the robot moves"
        what, fix = _stuck_words([part for part, _ in bad]), "check the sensor and the columns, or leave these rows out"
        warn_user(sentence(what, expected=expected, fix=fix))


def warn_of_outliers(outlying: Sequence[Outlier], data: Any) -> None:
    """Warn if so many rows, of all or of one device, are outliers that the inliers may be the wrong ones.

    Args:
        outlying: the outliers among the rows of a table, the worst first. data: the table.
    """
    wrong = list({outlier.row for outlier in outlying})
    flags, devices = flagged(len(data), wrong), list(_device_rows(data))
    many = [part for part in devices if float(flags[part.rows].double().mean()) > gates.GROSS_SHARE]
    if not many and float(flags.double().mean()) <= gates.GROSS_SHARE:
        return
    counts = few([f"{int(flags[part.rows].sum())} of {len(part.rows)} {part.words}" for part in many], MOST_NAMES)
    held = [part for part in stuck_columns(data) if bool(flags[part.rows].any())]
    also = f"; {_stuck_words(held)}: a stuck sensor?" if held else ""
    if float(flags.double().mean()) > gates.GROSS_SHARE:
        what = f"{len(wrong)} of {len(data)} rows are outliers: do not rely on this calibration"
        fix = "check that rows pair joints with their own points, and that markers keep their numbers"
        fix += f"; most of them are {counts}" * (0 < len(many) < len(devices))
    else:
        what = f"{counts} are outliers, so that they hardly count"
        fix = "check these devices, their columns and units; of a set-up, whether more has moved than was said: leave "
        fix += "it out, and recalibrate the model with its rows alone, which finds both device and markers"
    expected, got = f"at most {100 * gates.GROSS_SHARE:.0f} %", f"for the worst row: {outlying[0].reason}"
    warn_user(sentence(what, expected=expected, got=got, fix=fix + also))


def flagged(count: int, rows: Sequence[int]) -> Tensor:
    """(N,) boolean, true in some rows."""
    flags = torch.zeros(count, dtype=torch.bool, device=HOST)
    flags[list(rows)] = True
    return flags
