"""Find where the measuring device stands and where the markers sit, from a few rows and a calibrated model.

With everything else kept, the rows see the model through a small motion of the measuring frame and of the markers, see
new_rows.py, after a start in closed form (robots/placement.py). A marker either stayed where it was (within 0.01 mm),
moved a little (1 mm), or is another one (0.3 m): the marginal likelihood of the rows chooses. The base may be anywhere.

Leaving rows J out lowers their quadratic form by mu_J^T (K^-1)_JJ^-1 mu_J. Compared with what remains, this is an F
test (externally studentised residuals), so that an outlier does not hide itself. Rows whose weights say that they are
gross go first, together: they may hide each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, log
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import SampledRows, changes_of_set_up
from diffeo_calib.calibration.diagnostics.judge import best_of, changed, two_tools
from diffeo_calib.calibration.recalibration.new_rows import OUTLIER_WEIGHT, NewRows, NewSetUp, UsualNoise
from diffeo_calib.common.checks import check_number
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, as_written, few, sentence, warn_user
from diffeo_calib.common.quantiles import known
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import FlangePoints
from diffeo_calib.kinematics.registered_map import HARDLY, Registration, fitted_markers, robot_map, turned, undetermined
from diffeo_calib.kinematics.tool import TOOL_LEVER, tool_points, tool_transform
from diffeo_calib.measurements.bodies import Bodies
from diffeo_calib.measurements.poses import kind_of_points, own_blocks, poses_from_marks
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.tails import Tails
from diffeo_calib.robots.placement import PLACES, place, rigid_fit
from diffeo_calib.robots.se3 import twist_at
from diffeo_calib.sensors.coordinates import check_joint_order
from diffeo_calib.sensors.devices import CHANGE
from diffeo_calib.sensors.kinds import Coordinates

FREE = ("both", "base", "marker")
MARKER_DEVIATIONS = {
    "same": (PLACES.same_registered_m, PLACES.same_m),
    "moved": (PLACES.remounted_m, PLACES.remounted_m),
    "other": (PLACES.other_registered_m, PLACES.other_m),
}
"""Prior standard deviations, m, of markers from where they were, in a registration, and from where it found them."""
OTHER_MARKER = MARKER_DEVIATIONS["other"][0]
UNMOVED_LOG_ODDS = log(10.0)  # before the rows are seen: markers that nobody names as moved have not been touched
MOST_ROWS = 200  # of more rows, so many evenly spaced ones take part
BEYOND_REACH = 10.0  # distance of rows from their middle, in reaches of the robot or m, from which their unit is wrong
LARGEST_OUTLIER_PART = 0.34  # largest part of the rows that are taken for outliers
NEGLIGIBLE_PROBABILITY = 0.01  # priors that are less probable count no more
LEAST_POINTS = 3  # points that determine where a frame is


def find_place(
    model: FittedMap,
    lever: float | None,
    data: Measurements,
    *,
    free: str = "both",
    marker_std: float | None = None,
    ball: bool = False,
    opens: bool = False,
) -> tuple[NewRows, Registration]:
    """Find where the device stands and where the markers sit.

    Args:
        model: the map, placed anew before or not. lever: of its frames, m; None for markers.
        data: the rows. free, marker_std: see :meth:`CalibratedKinematics.registered`.
        ball: whether the last marker is a ball that no row shows, and that stays where it was on the tool.
        opens: whether something may have changed among the rows.

    Returns:
        the rows around the most probable places, with their prior, and the record.

    Raises:
        InputError: arguments of another kind, or markers that are to stay, but other ones were measured.
        MeasurementError: no more coordinates than unknowns without a prior, or rows that no place explains.
    """
    if free not in FREE:
        raise InputError.of("`free`", expected=" or ".join(map(repr, FREE)), got=as_written(free))
    chain = robot_map(model.unregistered).geometry.chain
    check_joint_order(chain, data)
    data = data.to(HOST)
    chain.joint_values(data.q)
    if marker_std is not None:
        check_number(marker_std, "`marker_std`, in m", above=0.0)
    evenly = [round(k * (len(data) - 1) / (MOST_ROWS - 1)) for k in range(MOST_ROWS)]
    some = data if len(data) <= MOST_ROWS else data.rows(evenly)
    middle = some.points.flatten(0, 1).nanmedian(0).values
    spread = _refuse_others(some.points - middle, BEYOND_REACH * max(chain.reach, 1.0))
    search = Search.of(model, lever, some, free, ball=ball)
    priors = {name: first for name, (first, _) in MARKER_DEVIATIONS.items() if search.known or name == "other"}
    priors = priors if marker_std is None else {"stated": marker_std}
    priors = {"same": 0.0} if free == "base" else priors
    starts = search.starts(max(priors.values()))
    placed = dict[str, NewRows]()
    for name, metres in priors.items():
        prior = {"deviations": search.deviations(metres), "marker": name}
        settled = [start.changed(**prior).settled() for start in (starts if metres >= OTHER_MARKER else starts[:1])]
        placed[name] = max(settled, key=lambda each: each.given.log_evidence())
    kept, outliers = torch.arange(len(some), device=some.q.device), list[int]()
    while True:
        odds = _odds(placed)
        best = placed[max(odds, key=odds.__getitem__)]
        worst = worst_rows(best)
        if not worst or len(outliers) + len(worst) > LARGEST_OUTLIER_PART * len(some):
            break
        outliers += kept[worst].tolist()
        stay = kept.new_tensor([row for row in range(len(kept)) if row not in worst])
        kept, placed = kept[stay], {name: rows.kept(stay).settled() for name, rows in placed.items()}
    most = max(gates.LARGEST_PER_REACH * chain.reach, gates.REGISTERED_RESIDUAL * spread)
    _refuse_others(best.given.shown(best.given.residual).unflatten(1, (-1, 3)), most)
    if opens and (beside := opened(best, some.rows(kept))) is not best:
        best = beside.settled()
    return best, _record(
        best,
        lever=search.data.lever,
        free=free,
        outliers=tuple(some.line_numbers[sorted(outliers)].tolist()),
        shift=-best.away[6:].view(-1, 3) if search.known else None,
        rms_before=_rms(model(some.q).unflatten(1, (-1, 3)) - some.points) if search.known else None,
        same_place=odds.get("same", 0.0) if len(priors) > 1 else None,
    )


def _odds(placed: Mapping[str, NewRows]) -> dict[str, float]:
    """Probability of each prior of the markers, without those that hardly count."""
    scale = max(1.0, float(scale_of([*placed.values()][-1])[0]))  # large errors under the widest prior are none
    logs = {name: rows.given.log_evidence(scale) + UNMOVED_LOG_ODDS * (name == "same") for name, rows in placed.items()}
    odds = {name: exp(value - max(logs.values())) for name, value in logs.items()}
    likely = {name: share for name, share in odds.items() if share > NEGLIGIBLE_PROBABILITY * sum(odds.values())}
    return {name: share / sum(likely.values()) for name, share in likely.items()}


@dataclass(frozen=True, eq=False)
class Search:
    """What may be open in rows of a new set-up, and where a search for it may begin."""

    model: FittedMap  # the map, placed anew before or not, under the payloads of the rows
    fit: FittedMap  # the map of the fit
    data: Measurements  # M rows that show P points
    old: Tensor  # (P, 3) where the model has them, or at the tip, m
    known: bool  # whether they may be there
    same: bool  # whether the markers are those of the fit
    free: Tensor  # (6 + 3 P,) boolean, which unknowns of frame and points may have moved

    @classmethod
    def of(cls, model: FittedMap, lever: float | None, data: Measurements, free: str, *, ball: bool) -> Search:
        """The rows beside a model; arguments and errors as of :func:`find_place`."""
        before, fit = model.registration, model.unregistered
        markers = fitted_markers(fit) if before is None else before.markers
        bodies, shown = Bodies(lever), data.bodies
        alike = bodies.kind == shown.kind and data.markers == len(markers)
        if alike:
            data, shown = bodies.represented(data), bodies
        elif free == "base":
            what, fix = 'free="base" keeps the markers', 'pass free="both" for other markers'
            got = kind_of_points(data.markers, data.lever)
            raise InputError.of(what, expected=kind_of_points(len(markers), lever), got=got, fix=fix)
        old = markers if alike else shown.nowhere(data.markers, data.points)
        numbers = torch.arange(6 + old.numel(), device=data.q.device)
        may = torch.where(numbers < 6, free != "marker", free != "base") & (numbers < len(numbers) - 3 * ball)
        _check_enough(data, framed=free != "marker", known=alike)
        model = model.with_nominal(robot_map(fit).under(data.payload))
        return cls(model, model.unregistered, data, old, alike, alike and (before is None or before.same), may)

    def deviations(self, metres: float) -> Tensor:
        """(6 + 3 P,) of frame and points before the rows, for a deviation of the markers from their old places, m."""
        values = [PLACES.sought_base_m_rad] * 6 + [metres] * self.old.numel()
        return self.free * self.old.new_tensor(values)

    def starts(self, widest: float) -> list[NewRows]:
        """The rows around each of the places where a search may begin, with the widest prior of the markers, m.

        The first has the markers at their old places, if known; the other, anywhere, if they may be. For another number
        of markers each has the mean noise of the fitted ones.
        """
        data, framed, block = self.data, bool(self.free[0]), self.model.new_noise
        set_up = NewSetUp(self.fit, data, Coordinates(data, torch.arange(len(data), device=data.q.device)))
        factor = float(block.trace() / self.fit.new_noise.trace()) if self.known else 0.0
        if len(block) != 3 * data.markers:
            block = torch.block_diag(*[own_blocks(block[None], len(block) // 3)[0].mean(0)] * data.markers)
        places = [] if framed and not self.known else [self.at_old_places()]
        may = self.free[6:].view(data.markers, -1).any(1)
        shown = (~data.points.isnan()).any(2).any(0) | ~may  # else some marker could be anywhere
        # as many coordinates as unknowns would fit any place
        open_ = framed and bool(may.any()) and bool(shown.all()) and len(known(data.points)) > len(self.free)
        if not places or (open_ and widest >= OTHER_MARKER):
            places.append(self.anywhere())
        starts, by_fit = [], self._by_fit()
        for T, markers in places:
            rows = set_up.rows((T, markers), UsualNoise(block, factor), self.deviations(widest), same=self.same)
            away = torch.cat([self.old.new_zeros(6), (self.old - markers).flatten()])
            starts.append(rows.changed(away=away, known=self._earlier(rows.centre), by_fit=by_fit))
        return starts

    def _earlier(self, centre: Tensor) -> Tensor:
        """(6 + 3 P, 6 + 3 P) covariance of frame and points by an earlier registration; zero without one."""
        before, covariance = self.model.registration, centre.new_zeros(len(self.free), len(self.free))
        if before is None:
            return covariance
        size = len(covariance) if self.known else 6
        to = torch.eye(size, dtype=covariance.dtype, device=covariance.device)
        to[:6, :6] = twist_at(centre - before.centre)
        covariance[:size, :size] = to @ before.covariance[:size, :size] @ to.mT
        return covariance

    def _by_fit(self) -> Tensor:
        """(3 P, 3 P) covariance of the points' old places by the fit where it hardly knew them; a part of C."""
        if not self.same:
            return self.old.new_zeros(self.old.numel(), self.old.numel())
        nominal = robot_map(self.fit)
        part = nominal.geometry.slices["tool"]
        numbers = torch.arange(part.start, part.stop, device=self.old.device)
        variances, Q = torch.linalg.eigh(self.fit.with_nominal(nominal.typical).parameter_covariance(numbers))
        return (Q * (variances * (variances > HARDLY**2 * self.fit.new_noise.diagonal().mean()))) @ Q.mT

    def at_old_places(self) -> tuple[Tensor, Tensor]:
        """Frame (4, 4) in closed form, m, and the points where they were."""
        T = torch.eye(4, dtype=self.data.q.dtype, device=self.data.q.device)
        if bool(self.free[0]):
            marks = FlangePoints(robot_map(self.fit), self.old, same=self.same)
            points = self.fit.geodesic.with_nominal(marks)(self.data.q)
            T = rigid_fit(points.view(-1, 3), self.data.points.flatten(0, 1))
        return T, self.old

    def anywhere(self) -> tuple[Tensor, Tensor]:
        """Frame (4, 4) and points in closed form, m; what never moves stays."""
        geometry, points = robot_map(self.fit).geometry, self.data.points
        tips = list(dict.fromkeys(geometry.on)) if len(geometry.on) == points.shape[1] else [geometry.on[0]]
        corners = tool_points(tool_transform(None).to(points.device)).repeat(len(tips), 1)
        marks = FlangePoints(robot_map(self.fit), corners, on=tuple(tip for tip in tips for _ in range(3)))
        predicted = self.fit.geodesic.with_nominal(marks)(self.data.q)
        poses = poses_from_marks(predicted.view(-1, 3, 3), TOOL_LEVER)
        carrying = [tips.index(tip) for tip in geometry.on] if len(tips) > 1 else [0] * points.shape[1]
        placement = place(poses.view(-1, len(tips), 4, 4)[:, carrying], points)
        shown = (~points.isnan()).any(2).any(0)
        return placement.base, torch.where(shown[:, None], placement.tool, self.old)


def _check_enough(data: Measurements, *, framed: bool, known: bool) -> None:
    """Raise MeasurementError unless there are more coordinates than unknowns without a prior."""
    bodies = data.bodies
    each = bodies.numbers * float(data.seen_bodies.sum()) / len(data)
    unknowns = 6 * framed + bodies.numbers * (data.markers // bodies.points) * (not known)
    points = -(-LEAST_POINTS // data.markers) if framed else 1
    least = max(int(unknowns // each) + 1, points)  # one coordinate more than unknowns: a contradiction can show
    if len(data) < least:
        what, fix = "these rows do not determine where everything is", "measure 6 to 10 poses"
        raise MeasurementError.of(what, expected=f"at least {least} rows", got=len(data), fix=fix)


def _refuse_others(away: Tensor, most: float) -> float:
    """Typical length of vectors (N, P, 3), m; MeasurementError if those of no calibrated robot are as long."""
    typical = float(away.norm(dim=-1).nanmedian())
    if typical > most:
        what, fix = "no place of device and markers explains these rows", "check that they are of this robot, `length`"
        fix += " and `angle`, and the order of the columns"
        raise MeasurementError.of(what, expected=f"at most {most:.3g} m", got=f"a median of {typical:.3g} m", fix=fix)
    return typical


PRIOR_FREEDOM = 10.0  # the model's own covariance counts as an estimate of the scale with so many degrees of freedom
FALSE_ALARM_PROBABILITY = 0.001  # probability that clean rows have an outlier


def scale_of(rows: NewRows, falls: Tensor | float = 0.0, coordinates: Tensor | int = 0) -> tuple[Tensor, Tensor]:
    """Square of the residuals' scale in units of what model and noise lead to expect, and degrees of freedom.

    Args:
        falls: of the quadratic form by rows that are left out. coordinates: how many these have.
    """
    given = rows.given
    determined = len(given.prior) - torch.cholesky_inverse(given.factor.B).trace()
    freedom = (given.visible.sum() - coordinates - determined).clamp(min=0.0) + PRIOR_FREEDOM
    return ((given.target @ given.solved.flatten() - falls).clamp(min=0.0) + PRIOR_FREEDOM) / freedom, freedom


def worst_rows(rows: NewRows) -> list[int]:
    """The row that contradicts all others, or rows that are more likely gross than good; or none."""
    from scipy.special import fdtrc  # noqa: PLC0415  # slow to import, not needed to use a model

    if (tails := rows.with_weights().tails).gross:
        return (tails.weights < OUTLIER_WEIGHT).any(1).nonzero()[:, 0].tolist()
    given = rows.given
    if len(rows) <= LEAST_POINTS:
        return []
    falls, coordinates = given.left_out_squares, given.visible.sum(1).to(given.residual)
    variances, freedom = scale_of(rows, falls, coordinates)
    ratios = falls / coordinates / variances
    chances = torch.from_numpy(fdtrc(*(each.numpy(force=True) for each in (coordinates, freedom, ratios))))
    best = int(ratios.masked_fill((chances > chances.min()).to(ratios.device), 0.0).argmax())  # of equal chances
    return [best] if float(chances[best]) * len(rows) < FALSE_ALARM_PROBABILITY else []


def opened(rows: NewRows, data: Any) -> NewRows:
    """The rows beside what has changed of device and tool among them; as they are if nothing has."""
    if len(rows) < 4 * gates.CHANGE_ROWS:
        return rows
    shown, chain, mine = rows.visible[..., None], rows.nominal.geometry.chain, rows.placement
    frame, markers = (rows.by_places * shown).tensor_split([6], 2)
    cases = changes_of_set_up(frame, markers, rows.at.joint_to_start * shown, chain) + mine.hypotheses(rows, CHANGE)
    named = [case._replace(name=mine.bodies.get(case.name, case.name)) for case in cases if bool(case.effects.any())]
    sampled = SampledRows(torch.arange(len(rows), device=shown.device), rows.process, None)
    cases = changed(sampled, named, data.line_numbers, data.row_names)
    causes = [cause for cause in cases if cause.what.split(" seems")[0] not in chain.joint_names]  # see find_changes.py
    if len(rows) >= gates.MIXED_ROWS:
        causes += two_tools(sampled, markers, data.line_numbers)
    best = best_of(causes, sampled)
    if best is None:
        return rows
    columns = rows.shared[..., :0] if best.columns is None else best.columns
    shared, tails = torch.cat([columns, rows.shared], 2), Tails.none(*rows.tails.weights.shape)
    return rows.changed(shared=shared, tails=tails, changed_among=best.text)


def _record(best: NewRows, *, lever: float | None, **said: Any) -> Registration:
    """Everything in the new measuring frame; ``said``: what else the record holds."""
    given, markers, free, T = best.given, best.marks.points, best.free, best.transform
    R, k = T[:3, :3], len(best.free)
    whole, gain = best.known.clone(), given.gain.new_zeros(len(best.known), given.gain.shape[1])
    whole[free], whole[:, free], gain[free] = 0.0, 0.0, given.gain[:k]
    whole[free[:, None], free] = given.covariance[:k, :k] * best.inflation
    out = torch.block_diag(R, R, torch.eye(markers.numel(), dtype=R.dtype, device=R.device))
    covariance = out @ whole @ out.mT
    covariance = 0.5 * (covariance + covariance.mT)
    usual = float((best.inflation * given.V.diagonal()[given.visible.flatten()].median()).sqrt())
    arm = float((given.shown(best.y).unflatten(1, (-1, 3)) - best.centre).square().sum(-1).nanmean().sqrt())
    geometry, count = best.marks.fitted.geometry, len(markers)
    tips = geometry.on if len(geometry.on) == count else (geometry.chain.tip,) * count
    return Registration(
        transform=T,
        markers=markers,
        lever=lever,
        same=best.marks.same,
        covariance=covariance,
        centre=R @ best.centre + T[:3, 3],
        q=best.q,
        gain=((out @ gain).unflatten(1, (-1, 3)) @ R.mT).flatten(1),
        noise=turned(best.inflation * best.mean_noise, R),
        rms_after=_rms(given.shown(given.residual).unflatten(1, (-1, 3))),
        left_out_rms=_rms(given.left_out.unflatten(1, (-1, 3))),
        excess=float(scale_of(best)[0]) ** 0.5,
        undetermined=undetermined(covariance, markers, arm, usual, tips, rigid=lever is not None),
        **said,
    )


def _rms(errors: Tensor) -> float:
    """Root mean square length of vectors (..., 3), NaN left out."""
    return float(errors.norm(dim=-1).square().nanmean().sqrt())


UNLIKELY = 0.01  # probability of what is said of the markers, below which it is warned of


def warn_about(
    record: Registration | None, *, outliers: bool = True, excess: bool = True, marker: str = "", among: str = ""
) -> None:
    """Warn of outliers, of exchanged markers, of directions that rows do not determine, and of errors that remain.

    Args:
        record: the registration, if a device measured coordinates. marker: what is said of the markers.
        outliers: whether to name the rows that took no part. excess: whether to warn of errors that remain.
        among: what has changed among the rows, in a sentence.
    """
    if among:
        warn_user(among)
    if record is None:
        return
    if record.outliers and outliers:
        what = f"{len(record.outliers)} row(s) contradict all others and took no part: row {few(record.outliers)}"
        warn_user(sentence(what, fix="measure these poses again"))
    if record.exchanged:
        what = f"markers {few(record.exchanged)}, or axes of a measured frame, seem to be exchanged"
        warn_user(sentence(what, fix="put their columns in the order of the fit, unless they were mounted so"))
    for text in record.undetermined:
        warn_user(f"{text}.")
    if record.doubtful and excess:
        what = f"after registration the errors are {record.excess:.1f} times as large as the model leads to expect"
        fix = "something else has changed, or the rows are wrong: measure more poses and calibrate again"
        warn_user(sentence(what, fix=fix))
    if marker == "same" and record.same_place is not None and record.same_place < UNLIKELY and record.shift is not None:
        what = f"the rows say that the markers have moved by {1e3 * float(record.shift.norm(dim=1).max()):.2g} mm"
        warn_user(sentence(f'{what}, although marker="same"', fix="leave this out, in commands --free base"))
