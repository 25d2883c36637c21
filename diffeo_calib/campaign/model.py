"""State of knowledge of a campaign: places, scales and the posterior of its accepted rows, and the last rows."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from itertools import combinations
from math import inf, isinf, pi
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import VARIANCE_RATIO, choose_scales, noise_of_few
from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import changes_of
from diffeo_calib.calibration.diagnostics.plausibility import check_joints
from diffeo_calib.calibration.placing.place import Placed, place
from diffeo_calib.calibration.planning.candidates import candidates, ranges_around
from diffeo_calib.calibration.planning.scene import greedy
from diffeo_calib.calibration.scales.leave_one_out import variance_ratio
from diffeo_calib.calibration.scales.selection import GROWTH, defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.campaign.verdicts import Change, Seen, Verdict, find_change
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, MeasurementError, few
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.fitting.result import silent
from diffeo_calib.maps.linearisation import Linearisation, Numbers
from diffeo_calib.maps.noise import without_hidden
from diffeo_calib.measurements.bodies import Bodies
from diffeo_calib.measurements.observations import joined_tables
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.conditional import Features, Process, diagonal_blocks
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import CHANGE, Hypothesis
from diffeo_calib.sensors.kinds import rows_of_one_kind
from diffeo_calib.sensors.set_ups import frame_slopes

MOST_COORDINATES = 4500  # measured numbers of a posterior: of more rows a random sample stands for all
EXCEEDANCE_PROBABILITY = 0.05  # probability that the true error is above its limit
INFORMATION_COORDINATES, LOG_SCALE_STEP = 450, 0.2
"""Measured numbers of random rows that say how certain scales are; step of a log scale between which they change."""
UNITS = ((1e-3, "1000 times too large: mm as m?"), (1e3, "1000 times too small: m as mm?"))


@dataclass(eq=False)
class Around:
    """Places and scales of some accepted rows, around which all rows are linearised.

    Args:
        placed: geometry and devices. data: the rows they were found with. scales: of the model.
        candidates: (M, n), poses to measure, and target (T, n), where the robot shall be accurate, rad or m.
        selected: rows that the scales were selected with. deviation: of the log expected error by uncertain scales;
            infinite where they are not selected.
    """

    placed: Placed
    data: TangentData
    scales: Hyperparameters
    candidates: Tensor
    target: Tensor
    selected: int
    deviation: float = inf

    @classmethod
    def of(
        cls, robot: Tree, rows: Any, asked: tuple[Tensor, Tensor], same: Around | None, *, first: bool, seed: int
    ) -> Around:
        """Around accepted rows.

        Args:
            asked: candidates and target. same: that with the scales to keep; None to select them, unless these are the
                ``first`` rows, which are too few for that.

        Raises:
            DiffeoCalibError: rows that do not allow a model yet.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DiffeoCalibWarning)  # few rows leave much open
            check_joints(robot, rows)
            placed = place(robot, rows, silent)
            data, stages = placed.tangent_data(), (placed.registration, placed.identification)
            initial = None if same is None else same.scales
            if initial is None and first:
                initial = defaults(data, noise_of_few(data, len(rows), *stages), placed.identification.prior)
            scales = None if initial is None else replace(initial, lines=())
            chosen = choose_scales(data, rows, *stages, given=scales, seed=seed)
        ratio = variance_ratio(chosen.data, chosen.left_out) if first else 0.0
        if ratio > VARIANCE_RATIO:  # around wrong places all later rows would be wrong
            expected, got = "squared errors of single rows as the others predict them", f"{ratio:.2g} times that"
            fix = "measure more rows, then the model is made"
            raise MeasurementError.of("the first rows do not fit together yet", expected=expected, got=got, fix=fix)
        how = (0 if first else len(rows), inf) if same is None else (same.selected, same.deviation)
        return cls(placed, chosen.data, chosen.selection.scales, *asked, *how)

    def rows(self, others: Any) -> tuple[TangentData, Callable[[slice], list[Hypothesis]]]:
        """Rows of the campaign around the places, and what may change among some of robot, tool and devices.

        MeasurementError for devices that have no place.
        """
        old = self.placed.data
        unknown = set(others.device_names) - set(old.device_names)
        if unknown:
            fix = "they are judged once a model holds some of them"
            expected, got = few(sorted(set(old.device_names))), few(sorted(unknown))
            raise MeasurementError.of("the set-ups and devices of rows", expected=expected, got=got, fix=fix)
        anchors = old.rows([int(part.rows[0]) for part in rows_of_one_kind(old)])
        whole = joined_tables([anchors, others])
        placed, data = self.placed.beside(whole, self.data)
        index = torch.arange(len(anchors), len(whole), device=HOST)
        rows, devices = data.rows(index), cache(lambda: placed.placement.hypotheses(data, CHANGE))
        return rows, lambda some: changes_of(rows.rows(_numbers(some.start, some.stop)), devices(), index[some])

    def told(self, data: TangentData) -> tuple[Numbers, Tensor]:
        """What rows tell, and its noise (N, R, R), m^2."""
        return data.numbers(self.scales), data.noise_of_numbers(self.scales)

    def process(self, table: Any, accepted: Sequence[int]) -> Process:
        """What is known by rows of the campaign."""
        place_of = {row: number for number, row in enumerate(self.placed.data.line_numbers.tolist())}
        mine = [place_of[row] for row in accepted if row in place_of]
        later = [row for row in accepted if row not in place_of]
        process: Any = self.data.prior(self.scales)
        if mine:
            rows = self.data.rows(torch.tensor(mine, dtype=torch.int64, device=HOST))
            process = rows.sample(len(mine), MOST_COORDINATES, 0)[1].process(self.scales)
        return process.given(*self.told(self.rows(table.rows(later))[0])) if later else process

    @cached_property
    def like(self) -> int:
        """Number of the last row as which some of the candidates can be measured; else the very last."""
        last = len(self.placed.data) - 1
        return next((row for row in range(last, -1, -1) if bool(self._sees(row, self.candidates).any())), last)

    def _sees(self, row: int, q: Tensor) -> Tensor:
        """(M,) boolean: configurations in which a row can be measured."""
        every = torch.ones(len(q), dtype=torch.bool, device=q.device)
        return torch.stack([every, *(moved.there for moved in self.placed.elsewhere(row, q))]).all(0)

    @cached_property
    def open(self) -> Tensor:
        """(M,) boolean, candidates that can be measured."""
        return self._sees(self.like, self.candidates)

    def with_open_candidates(self, count: int, seed: int) -> Around:
        """Draw ``count`` candidates that can be measured where some of the present ones cannot."""
        elsewhere = self.placed.elsewhere(self.like, self.candidates)
        geometry, places = self.placed.identification.geometry, [moved.places for moved in elsewhere]
        chain, base = geometry.chain, geometry.base
        how: Any = {"ranges": ranges_around(chain, self.placed.data.q), "keep": partial(self._sees, self.like)}
        if any(map(len, places)):
            how |= {"places": (torch.cat(places) - base[:3, 3]) @ base[:3, :3], "ball": geometry.tool[-1]}
        with suppress(InputError):  # hardly any can
            if not bool(self.open.all()):
                return replace(self, candidates=candidates(chain, count, seed=seed, **how))
        return self

    @cached_property
    def options(self) -> tuple[Linearisation, Tensor]:
        """What the candidates would tell, and its noise (M, r, r), m^2."""
        copies = self.placed.data.rows([self.like] * len(self.candidates))
        copies: Any = with_attributes(copies.parts[0], q=self.candidates)
        for moved in self.placed.elsewhere(self.like, self.candidates):
            copies = moved.changed(copies)
        numbers, noise = self.told(self.rows(copies)[0])
        return numbers.at, noise

    @cached_property
    def errors(self) -> tuple[Linearisation, Tensor]:
        """The markers, or the origins of poses, at the target, and (T r, T r) what of their errors counts.

        Without a measuring device rigid motions of all of them do not.
        """
        q, typical = self.target, self.data.nominal.typical
        data = replace(self.data, nominal=typical, x=q, shared=None, observe=None, beside=None)
        A, points = Bodies(self.placed.lever).averaging(data.points), data.points.unflatten(1, (-1, 3))
        at = data.linearisation(self.scales).projected(A.expand(len(q), *A.shape))
        compared = torch.eye(len(q) * len(A), dtype=A.dtype, device=A.device)
        if self.placed.free:
            B = (A @ frame_slopes(points, points.mean((0, 1)))).flatten(0, 1)
            compared -= B @ torch.linalg.pinv(B)
        return at, compared

    def covariance(self, target: Features) -> Tensor:
        """Covariance (T r, T r) of the errors over the target, m^2."""
        compared = self.errors[1]
        return compared @ target.between() @ compared

    def with_deviation(self) -> Around:
        """With the standard deviation of the log RMS error over the target by uncertain scales.

        It is s with s^2 = g^T F^-1 g, g the gradient of the logarithm by the log scales, with the Fisher information of
        the rows, whose covariance K has the derivatives K_i by log scales, and the prior,

            F_ij = 1/2 tr(K^-1 K_i K^-1 K_j) + delta_ij / width^2.
        """
        _, some = self.data.sample(len(self.data.x), INFORMATION_COORDINATES, 0)
        point, white, slopes = self.scales.logarithms(), list[Tensor](), list[float]()

        def at(logarithms: Tensor) -> tuple[Tensor, float]:
            """Covariance of the rows, and log RMS error over the target."""
            process = some.process(self.scales.from_logarithms(logarithms))
            target = process.features(replace(self.errors[0], spec=process.numbers.at.spec))
            return process.factor.matrix, 0.5 * float(self.covariance(target).trace().log())

        low = torch.linalg.cholesky(at(point)[0])
        for step in LOG_SCALE_STEP * torch.eye(len(point), dtype=point.dtype, device=point.device):
            (K, value), (K_before, value_before) = at(point + step), at(point - step)
            half = torch.linalg.solve_triangular(low, (K - K_before) / (2 * LOG_SCALE_STEP), upper=False)
            white.append(torch.linalg.solve_triangular(low, half.T, upper=False).flatten())
            slopes.append((value - value_before) / (2 * LOG_SCALE_STEP))
        W, g = torch.stack(white), torch.tensor(slopes, dtype=point.dtype, device=point.device)
        F = 0.5 * W @ W.T + torch.eye(len(g), dtype=W.dtype, device=W.device) / GROWTH**2
        return replace(self, deviation=float(g @ torch.linalg.solve(F, g)) ** 0.5)


class CampaignModel:
    """What the accepted rows say.

    Args:
        around: places and scales. table: all rows. verdicts: on them. ratios: of accepted rows, see :attr:`typical`.

    Attributes:
        seen: rows of the campaign when this was made. window: numbers of the last rows; ``numbers`` and
            ``noise`` are what these tell.
        process: what is known by the accepted rows but the last ones. now: by all of them.
        covariance: (T r, T r) of the errors over the target, m^2.
    """

    def __init__(self, around: Around, table: Any, verdicts: Sequence[Verdict], ratios: Sequence[float]) -> None:
        self.around, self.seen, self.ratios = around, len(table), list(ratios)
        placed, names = set(around.placed.data.device_names), table.device_names
        judged = [verdict for verdict in verdicts if names[verdict.row] in placed]
        accepted = [verdict.row for verdict in judged if verdict.accepted]
        first = accepted[(len(accepted) + 1) // 2]  # the others hold what is known
        self.window = [verdict.row for verdict in judged[-gates.WINDOW :] if verdict.row >= first]
        self.process = around.process(table, [row for row in accepted if row not in self.window])
        self.numbers, self.noise = around.told(around.rows(table.rows(self.window))[0])
        self._learn(verdicts)

    def rebuilt(self, table: Any, verdicts: Sequence[Verdict]) -> CampaignModel:
        """Around the same places, what the rows say that are accepted now, of devices that have a place."""
        return CampaignModel(self.around, table, verdicts, self.ratios)

    def check_placed(self) -> None:
        """MeasurementError while rows do not say where the robot stands: around a wrong place nothing can be judged."""
        if self.expected_error > PLACES.found_m_rad:
            got, fix = f"{1e3 * self.expected_error:.3g} mm", "measure more rows, of other poses and of every device"
            expected = f"an expected error below {1e3 * PLACES.found_m_rad:g} mm"
            raise MeasurementError.of(
                "the first rows do not show the places of the devices yet", expected=expected, got=got, fix=fix
            )

    @property
    def count(self) -> int:
        """Accepted rows that the places were found with."""
        return len(self.around.placed.data)

    @property
    def expected_error(self) -> float:
        """RMS error over the target, m, of the markers, or of the origins of poses."""
        return float((3 * self.covariance.diagonal().mean()).clamp(min=0).sqrt())

    @property
    def error_limit(self) -> float:
        """95 % quantile of the error over the target, m; infinite where it is not known."""
        return limit_of(self.expected_error, self.covariance, self.around.deviation)

    @property
    def typical(self) -> float:
        """How large right squares are relative to what chance exceeds in a share of the rows: at least one."""
        last = sorted(self.ratios[-gates.TYPICAL_ROWS :])
        if len(last) < gates.FEWEST_TYPICAL:
            return gates.TYPICAL_AT_FIRST
        return max(1.0, last[int(gates.TYPICAL_SHARE * len(last))])

    def next(self, count: int) -> tuple[list[int], list[float]]:
        """Candidates that lower the variance over the target most, and the expected error before and after each, m."""
        (at, noise), (aim, compared), open_ = self.around.options, self.around.errors, self.around.open
        options, target = self.now.features(at), self.now.features(aim)
        how: Any = {
            "place": torch.arange(len(noise), device=HOST),
            "open_": open_,
            "count": min(count, int(open_.sum())),
        }
        blocks = diagonal_blocks(options.between(), len(noise)) + noise
        order, by = greedy(compared @ target.between(options), options, blocks, **how)
        variance = self.covariance.diagonal().mean()[None]
        lowered = torch.cat([variance, -by.square().sum((1, 2)) / len(compared)]).cumsum(0)
        return order, (3 * lowered).clamp(min=0).sqrt().tolist()

    def judge(self, table: Any, verdicts: list[Verdict], lines: Sequence[int]) -> None:
        """Judge the rows of a table after those with a verdict, add theirs, and learn from those that are accepted.

        It ends before another row than the first that does not fit or shows a change: one by one they would all have
        the same verdicts.

        Args:
            lines: of all rows, see :attr:`Verdict.line`.

        Raises:
            MeasurementError: a device that is not known.
        """
        first, before = len(verdicts), len(self.window)
        window = [*self.window, *range(first, len(table))]
        data, changes = self.around.rows(table.rows(window))
        numbers, noise = self.around.told(data)
        at, target = self.process.features(numbers.at), self.process.features(self.around.errors[0])
        accepted = [verdicts[row].accepted for row in self.window] + [True] * (len(window) - before)
        root, given = Seen.of(self.process, numbers, noise, at).in_order(_flags(accepted))
        white = torch.linalg.solve_triangular(
            root, numbers.there(at.between(target)) @ self.around.errors[1], upper=False
        )
        expected = self._expected_errors(numbers, white, target)
        for number in range(before, len(window)):
            row, single, typical = window[number], given(number, number + 1), self.typical
            readings = data.rows(_numbers(number, number + 1))
            measure = single.measure(_freedom(readings))
            fits = measure.fits(typical)
            if number > before and not fits:
                break
            cause = "" if fits else self._cause(table.rows(slice(0, row + 1)), readings, single)
            verdict = Verdict(row, fits, fits, measure.error, measure.expected, cause, line=lines[row])
            last = slice(max(0, number - gates.WINDOW), number + 1)
            some, change = [*(verdicts[row] for row in window[last][:-1]), verdict], None
            if not cause:
                flags = _flags([judged.accepted for judged in some]), _flags([not judged.cause for judged in some])
                how: Any = {"typical": typical, "coordinates": data.y.shape[1]}
                change = find_change(given(last.start, last.stop), window[last], changes(last), flags, **how)
            if number > before and change is not None:
                break
            if fits:
                self.ratios.append(measure.square / chi2_above(1.0 - gates.TYPICAL_SHARE, measure.freedom))
            shown = self.around.placed.shown(table.rows([row]).parts[0])
            verdicts.append(replace(verdict, shown=shown, expected_error=expected[number]))
            if change is not None:
                _change(verdicts, window[last], change, lines)
            if change is not None or not fits:
                break
        self.window = window[: before + len(verdicts) - first]
        self.numbers, self.noise = numbers, noise
        self._let_go(verdicts)
        self._learn(verdicts)

    def _expected_errors(self, numbers: Numbers, white: Tensor, target: Features) -> list[float]:
        """RMS error over the target after each of some rows, m; ``white``: of their numbers, L^-1 cov with it."""
        last = numbers.owner.bincount(minlength=numbers.shape[0]).cumsum(0) - 1
        variance = (
            self.around.covariance(target).diagonal().mean() - white.square().sum(1).cumsum(0)[last] / white.shape[1]
        )
        return (3 * variance).clamp(min=0).sqrt().tolist()

    def _let_go(self, verdicts: Sequence[Verdict]) -> None:
        """Keep as many of the last rows as are looked at together; those of the others that are accepted are known."""
        count = max(0, len(self.window) - gates.WINDOW - 1)
        kept = _numbers(count, len(self.window))
        rows = _flags([verdicts[row].accepted for row in self.window[:count]]).nonzero()[:, 0]
        if len(rows):
            self.process = self.process.given(self.numbers.rows(rows), self.noise[rows])
        self.window, self.numbers, self.noise = self.window[count:], self.numbers.rows(kept), self.noise[kept]

    def _learn(self, verdicts: Sequence[Verdict]) -> None:
        """What is known now. Of the last rows those not accepted tell nothing."""
        accepted = _flags([verdicts[row].accepted for row in self.window])
        noise = without_hidden(self.noise, accepted[:, None].expand(self.noise.shape[:2]))
        self.now = self.process.given(self.numbers, noise)
        self.covariance = self.around.covariance(self.now.features(self.around.errors[0]))

    def _cause(self, table: Any, data: TangentData, view: Seen) -> str:
        """Why the last row is wrong, in words; empty if nothing that is undone makes it fit."""
        bodies, freedom = data.noise_model.bodies, _freedom(data)

        def fits(other: Seen, freedom: int) -> bool:
            return other.measure(freedom).fits(self.typical, gates.UNDONE_CHANCE)

        undone = self._undone(table.q, data.y[0].view(bodies, -1), self.around.placed.registration.geometry.chain)
        copies = table.rows([len(table) - 1] * len(undone))
        others = self.around.rows(with_attributes(copies.parts[0], q=torch.stack([q for q, _ in undone.values()])))[0]
        others = replace(others, y=torch.stack([y.flatten() for _, y in undone.values()]))
        numbers, noise = self.around.told(others)
        at = self.now.features(numbers.at)
        for number, words in enumerate(undone):
            row = _numbers(number, number + 1)
            if fits(Seen.of(self.now, numbers.rows(row), noise[row], at.rows(row)), freedom):
                return words
        body = view.numbers.cells * bodies // view.numbers.shape[1]
        good = [b for b in range(bodies) if fits(view.some(body != b), freedom * (bodies - 1) // bodies)]
        return f"marker {good[0]} seems to be wrong" if len(good) == 1 < bodies else ""

    @staticmethod
    def _undone(q: Tensor, y: Tensor, chain: Tree) -> dict[str, tuple[Tensor, Tensor]]:
        """Joint values (n,) and values (bodies, numbers) of the last of some rows (N, n), by the mistake undone."""
        turning, own = torch.tensor(chain.periodic, dtype=torch.bool, device=HOST), q[-1]
        undone = {f"its values seem to be {words}": (own, factor * y) for factor, words in UNITS}
        for a, b in combinations(range(len(y)), 2):
            order = [{a: b, b: a}.get(k, k) for k in range(len(y))]
            undone[f"markers {a} and {b} seem to be exchanged"] = own, y[order]
        undone["its joint values seem to be degrees as radians"] = torch.where(turning, own * pi / 180, own), y
        undone["its joint values seem to be converted to radians twice"] = torch.where(turning, own * 180 / pi, own), y
        undone["it seems to have been measured at the joint values of the row before"] = q[-2], y
        return undone


def _flags(values: Sequence[bool]) -> Tensor:
    return torch.tensor(values, dtype=torch.bool, device=HOST)


def _numbers(first: int, last: int) -> Tensor:
    return torch.arange(first, last, device=HOST)


def _change(verdicts: list[Verdict], window: Sequence[int], change: Change, lines: Sequence[int]) -> None:
    """Take rows out that came after a change, and those before it in again that an earlier one had taken out."""
    earlier = verdicts[window[0]].change
    if earlier is not None and change.row == window[0]:  # it is older than these rows
        change = replace(change, row=earlier.row)
    change = replace(change, line=lines[change.row])
    for number in window:
        verdict, before = verdicts[number], number < change.row
        if verdict.change is not None or not (before or verdict.cause or verdict.decided):
            accepted = before and bool(verdict.fits)
            verdicts[number] = replace(verdict, accepted=accepted, change=None if before else change)


def _freedom(data: TangentData) -> int:
    """Degrees of freedom of the bodies that a row shows."""
    return int(data.noise_model.freedom[data.noise_model.seen].sum())


def limit_of(error: float, covariance: Tensor, scales_deviation: float) -> float:
    """The error that the true one exceeds with 5 % probability, m.

    The mean square of errors N(0, S) is about chi-squared, with (tr S)^2 / tr S^2 degrees of freedom. Uncertain scales
    add 4 s^2 to its relative variance: 2 / nu = 2 tr S^2 / (tr S)^2 + 4 s^2.

    Args:
        error: the expected one, m. covariance: S (R, R), m^2. scales_deviation: s, that of its logarithm.
    """
    if isinf(scales_deviation):
        return inf
    freedom = 1.0 / (float(covariance.square().sum() / covariance.trace() ** 2) + 2.0 * scales_deviation**2)
    return error * (chi2_above(EXCEEDANCE_PROBABILITY, freedom) / freedom) ** 0.5
