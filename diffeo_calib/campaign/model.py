"""State of knowledge of a campaign: places, scales and the posterior of its accepted rows, and the last rows."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations
from math import inf, isinf, pi
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import VARIANCE_RATIO, choose_scales, noise_of_few
from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import changes_of
from diffeo_calib.calibration.placing.place import Placed, place
from diffeo_calib.calibration.planning.candidates import candidates, ranges_around
from diffeo_calib.calibration.planning.knowledge import greedy
from diffeo_calib.calibration.scales.leave_one_out import variance_ratio
from diffeo_calib.calibration.scales.selection import GROWTH, defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.campaign.verdicts import Seen, Verdict, find_change, measure
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning, InputError, MeasurementError, few
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.fitting.result import silent
from diffeo_calib.measurements.bodies import Bodies
from diffeo_calib.measurements.observations import joined_tables
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.process.numbers import Numbers
from diffeo_calib.process.process import Expected, Process
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import CHANGE, Hypothesis
from diffeo_calib.sensors.set_ups import frame_slopes
from diffeo_calib.sensors.tables import rows_of_one_kind

MOST_COORDINATES = 4500
"""Measured numbers of a posterior: of more rows a random sample stands for all."""
EXCEEDANCE_PROBABILITY = 0.05
"""Probability that the true error is above its limit."""
INFORMATION_COORDINATES, LOG_SCALE_STEP = 450, 0.2
"""Measured numbers of random rows that say how certain scales are; step of a log scale between which they change."""
UNITS = ((1e-3, "1000 times too large: mm as m?"), (1e3, "1000 times too small: m as mm?"))


@dataclass(eq=False)
class CampaignModel:
    """Places and scales of some accepted rows, and the posterior of all of them but the last.

    Args:
        placed: geometry and devices. data: the rows they were found with. scales: of the model.
        selected: accepted rows that the scales were selected with. count: those of this model.
        deviation: of the log expected error by uncertain scales; infinite where they are not selected.
        seen: rows of the campaign at that time. asked: candidates (M, n) and target (T, n), rad or m.
        process: what is known by the accepted rows but the last ones. window: numbers of the last rows.
        last: these around the places of the model. taken: (W,) boolean: those that were accepted.
        target, options: the target, and the candidates, as the process expected them at some time.
        compared: (T r, T r) what of the errors over the target counts.
        noise: (M, r, r) of the candidates, m^2. ratios: of accepted rows, see :attr:`typical`.
        open: (M,) boolean, candidates that can be measured.
    """

    placed: Placed
    data: TangentData
    scales: Hyperparameters
    selected: int
    deviation: float
    count: int
    seen: int
    asked: tuple[Tensor, Tensor]
    process: Process
    window: list[int]
    last: TangentData
    taken: Tensor
    target: Expected
    options: Expected
    compared: Tensor
    noise: Tensor
    ratios: list[float]
    open: Tensor

    @classmethod
    def of(
        cls,
        robot: Tree,
        table: Any,
        verdicts: Sequence[Verdict],
        asked: tuple[Tensor, Tensor],
        choice: tuple[Hyperparameters | None, bool, int],
        *,
        certain: bool = False,
    ) -> CampaignModel:
        """A model of the accepted rows.

        Args:
            choice: scales, None to select them; whether the rows are too few for that; a seed.
            certain: whether to say how certain selected scales are.

        Raises:
            DiffeoCalibError: rows that do not allow a model yet.
        """
        scales, first, seed = choice
        numbers = [one.row for one in verdicts if one.accepted]
        rows = table.rows(numbers)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DiffeoCalibWarning)  # few rows leave much open
            placed = place(robot, rows, silent)
            data, stages = placed.tangent_data(), (placed.registration, placed.identification)
            known = scales
            if scales is None and first:
                known = defaults(data, noise_of_few(data, len(numbers), *stages), placed.identification.prior)
            if known is not None:
                known = replace(known, lines=())
            chosen = choose_scales(data, rows, *stages, given=known, seed=seed)
        ratio = variance_ratio(chosen.data, chosen.left_out) if first else 0.0
        if ratio > VARIANCE_RATIO:  # around wrong places all later rows would be wrong
            expected, got = "squared errors of single rows as the others predict them", f"{ratio:.2g} times that"
            fix = "measure more rows, then the model is made"
            raise MeasurementError.of("the first rows do not fit together yet", expected=expected, got=got, fix=fix)
        found, data = chosen.selection.scales, chosen.data
        later: Any = [None] * 10  # what follows from the accepted rows
        counts = 0 if scales is None and first else len(numbers), inf, len(numbers), len(table)
        made = replace(cls(placed, data, found, *counts, asked, *later), ratios=[]).rebuilt(table, verdicts)
        if certain and known is None:
            made.deviation = made.scales_deviation()
        return made

    def rebuilt(self, table: Any, verdicts: Sequence[Verdict]) -> CampaignModel:
        """The same places and scales with the posterior of the rows that are accepted now, of devices that it knows."""
        placed, names = set(self.placed.data.device_names), table.device_names
        judged = [one for one in verdicts if names[one.row] in placed]
        accepted = [one.row for one in judged if one.accepted]
        first = accepted[(len(accepted) + 1) // 2]  # the others hold what is known
        window = [one.row for one in judged[-gates.WINDOW :] if one.row >= first]
        old = [row for row in accepted if row not in window]
        known = self.placed.data.line_numbers.tolist()
        place_of = {row: number for number, row in enumerate(known)}
        mine = torch.tensor([place_of[row] for row in old if row in place_of], dtype=torch.int64, device=HOST)
        _, some = self.data.rows(mine).sample(len(mine), MOST_COORDINATES, 0)
        process = some.process(self.scales)
        later = [row for row in old if row not in place_of]
        if later:
            process = process.given(*self._told(self.around(table.rows(later))[0]))
        own: dict[str, Any] = {"process": process, "window": window, "last": self.around(table.rows(window))[0]}
        own |= {"taken": _flags([verdicts[row].accepted for row in window]), "ratios": list(self.ratios)}
        errors, own["compared"] = self._errors()
        own["target"] = process.expected(errors)
        candidates, row = self.asked[0], self.like
        rows = table.rows([int(self.placed.data.line_numbers[row])] * len(candidates))
        like = self.placed.measured_at(row, with_joints(rows, candidates), candidates)
        options, (own["noise"],) = self._told(self.around(like)[0])
        own |= {"options": process.expected(options), "open": self.placed.sees(self.like, candidates)}
        return replace(self, **own, seen=len(table))

    def check_placed(self) -> None:
        """MeasurementError while rows do not say where the robot stands: around a wrong place nothing can be judged."""
        if self.expected_error > PLACES.found_m_rad:
            got, fix = f"{1e3 * self.expected_error:.3g} mm", "measure more rows, of other poses and of every device"
            expected = f"an expected error below {1e3 * PLACES.found_m_rad:g} mm"
            raise MeasurementError.of(
                "the first rows do not show the places of the devices yet", expected=expected, got=got, fix=fix
            )

    def with_open_candidates(self, count: int, seed: int, table: Any, verdicts: Sequence[Verdict]) -> CampaignModel:
        """The same with ``count`` candidates that can be measured, drawn where some of these cannot; else itself."""
        if bool(self.open.all()):
            return self
        robot = self.placed.registration.geometry.chain
        with suppress(InputError):  # hardly any can
            near = ranges_around(robot, self.placed.data.q)
            own: Any = {"ranges": near, **self.placed.places_to_reach(self.like)}
            q = candidates(robot, count, keep=partial(self.placed.sees, self.like), seed=seed, **own)
            return replace(self, asked=(q, self.asked[1])).rebuilt(table, verdicts)
        return self

    @cached_property
    def like(self) -> int:
        """Number of the row of the model as which the candidates would be measured, see :meth:`Placed.row_like`."""
        return self.placed.row_like(self.asked[0])

    @property
    def expected_error(self) -> float:
        """RMS error over the target, m, of the markers, or of the origins of poses."""
        return float((3 * self._covariance.diagonal().mean()).clamp(min=0).sqrt())

    @property
    def error_limit(self) -> float:
        """95 % quantile of the error over the target, m; infinite where it is not known."""
        return limit_of(self.expected_error, self._covariance, self.deviation)

    def scales_deviation(self) -> float:
        """Standard deviation of the log RMS error over the target by uncertain scales.

        It is s with s^2 = g^T F^-1 g, g the gradient of the logarithm by the log scales, with the Fisher information of
        the rows, whose covariance K has the derivatives K_i by log scales, and the prior,

            F_ij = 1/2 tr(K^-1 K_i K^-1 K_j) + delta_ij / width^2.
        """
        _, some = self.data.sample(len(self.data.x), INFORMATION_COORDINATES, 0)
        point, white, slopes = self.scales.logarithms(), list[Tensor](), list[float]()

        def at(logarithms: Tensor) -> tuple[Tensor, float]:
            """Covariance of the rows, and log RMS error over the target."""
            process = some.process(self.scales.from_logarithms(logarithms))
            errors = self.compared @ process.expected(self.target.numbers).covariance
            return process.factor.matrix, 0.5 * float((errors * self.compared).sum().log())

        low = torch.linalg.cholesky(at(point)[0])
        for step in LOG_SCALE_STEP * torch.eye(len(point), dtype=point.dtype, device=point.device):
            (K, value), (K_before, value_before) = at(point + step), at(point - step)
            half = torch.linalg.solve_triangular(low, (K - K_before) / (2 * LOG_SCALE_STEP), upper=False)
            white.append(torch.linalg.solve_triangular(low, half.T, upper=False).flatten())
            slopes.append((value - value_before) / (2 * LOG_SCALE_STEP))
        W, g = torch.stack(white), torch.tensor(slopes, dtype=point.dtype, device=point.device)
        F = 0.5 * W @ W.T + torch.eye(len(g), dtype=W.dtype, device=W.device) / GROWTH**2
        return float(g @ torch.linalg.solve(F, g)) ** 0.5

    @property
    def _covariance(self) -> Tensor:
        """Covariance (T r, T r) of the errors over the target, m^2."""
        return self.compared @ self._now[1].covariance @ self.compared

    @property
    def _now(self) -> tuple[Process, Expected]:
        """What all accepted rows say, and the target by them."""
        self.target = self.process.expected(self.target.numbers, self.target)
        taken = self.taken.nonzero()[:, 0]
        now = self.process.given(*self._told(self.last.rows(taken))) if len(taken) else self.process
        return now, now.expected(self.target.numbers, self.target)

    def next(self, count: int) -> tuple[list[int], list[float]]:
        """Candidates that lower the variance over the target most, and the expected error before and after each, m."""
        self.options = self.process.expected(self.options.numbers, self.options)
        now, target = self._now
        options, variance = now.expected(self.options.numbers, self.options), self._covariance.diagonal().mean()
        cross, K, (M, r) = self.compared @ now.between(target, options), options.covariance, self.noise.shape[:2]
        own, place = options.numbers.diagonal_blocks(K)[0] + self.noise, torch.arange(M, device=HOST)
        how: Any = {"place": place, "open_": self.open, "count": min(count, int(self.open.sum()))}
        order, by = greedy(cross, own, lambda row: K.view(M, r, -1)[row], **how)
        lowered = torch.cat([variance[None], -by.square().sum((1, 2)) / len(cross)]).cumsum(0)
        return order, (3 * lowered).clamp(min=0).sqrt().tolist()

    def judge(self, table: Any, verdicts: list[Verdict], lines: Sequence[int]) -> None:
        """Judge the last row of a table, add its verdict, and take in the row that leaves the window.

        Args:
            lines: of all rows, see :attr:`Verdict.line`.

        Raises:
            MeasurementError: a device that is not known.
        """
        row = len(table) - 1
        self.window.append(row)
        try:
            data, changes = self.around(table.rows(list(self.window)))
        except DiffeoCalibError:
            self.window.pop()
            raise
        last, seen = len(self.window) - 1, self._seen(*self._told(data))
        known = _flags([*(verdicts[number].accepted for number in self.window[:-1]), False])
        found, typical = measure(seen, last, known, _freedom(data, last)), self.typical
        fits = found.fits(typical)
        if fits:
            self.ratios.append(found.square / chi2_above(1.0 - gates.TYPICAL_SHARE, found.freedom))
        cause = "" if fits else self._cause(table, data, seen, known)
        shown = self.placed.shown(table.rows([row]).parts[0])
        verdicts.append(Verdict(row, fits, fits, found.error, found.expected, cause, shown=shown, line=lines[row]))
        own = [verdicts[number] for number in self.window]
        flags = _flags([one.accepted for one in own]), _flags([not one.cause for one in own])
        how: Any = {"single": found, "typical": typical, "coordinates": data.y.shape[1]}
        change = None if cause else find_change(seen, self.window, changes(), flags, **how)
        if change is not None:
            change = replace(change, line=lines[change.row])
            for number in self.window:
                own, before = verdicts[number], number < change.row
                if own.change is not None or not (before or own.cause or own.decided):
                    accepted = before and bool(own.fits)
                    verdicts[number] = replace(own, accepted=accepted, change=None if before else change)
        self._move_on(data, verdicts)

    @property
    def typical(self) -> float:
        """How large right squares are relative to what chance exceeds in a share of the rows: at least one."""
        last = sorted(self.ratios[-gates.TYPICAL_ROWS :])
        if len(last) < gates.FEWEST_TYPICAL:
            return gates.TYPICAL_AT_FIRST
        return max(1.0, last[int(gates.TYPICAL_SHARE * len(last))])

    def _move_on(self, data: TangentData, verdicts: Sequence[Verdict]) -> None:
        """Take the first row of a full window into the process, if it was accepted."""
        first, index = int(len(self.window) > gates.WINDOW), torch.arange(len(self.window), device=HOST)
        if first and verdicts[self.window[0]].accepted:
            self.process = self.process.given(*self._told(data.rows(index[:1])))
        self.window, self.last = self.window[first:], data.rows(index[first:])
        self.taken = _flags([verdicts[row].accepted for row in self.window])

    def _cause(self, table: Any, data: TangentData, seen: Seen, known: Tensor) -> str:
        """Why the last row is wrong, in words; empty if nothing that is undone makes it fit."""
        last, bodies, freedom = len(known) - 1, data.noise_model.bodies, _freedom(data, len(known) - 1)
        numbers, mine = seen.numbers, seen.numbers.owner == last

        def fits(other: Seen, some: Tensor | None = None, freedom: int = freedom) -> bool:
            return measure(other, last, known, freedom, some).fits(self.typical, gates.UNDONE_CHANCE)

        for words, other in self._undone(table, data, seen):
            if fits(other):
                return words
        size = numbers.shape[1] // bodies
        body = (numbers.cells % numbers.shape[1] // size).masked_fill(~mine, -1)
        good = [b for b in range(bodies) if fits(seen, mine & (body != b), freedom * (bodies - 1) // bodies)]
        return f"marker {good[0]} seems to be wrong" if len(good) == 1 < bodies else ""

    def _undone(self, table: Any, data: TangentData, seen: Seen) -> Iterator[tuple[str, Seen]]:
        """The last rows with a mistake of the last one undone, in words: in its values, and in its joint values."""
        row, y, each = self.window[-1], data.y[-1:], data.y[-1].unflatten(0, (data.noise_model.bodies, -1))
        values = [(f"its values seem to be {words}", factor * y) for factor, words in UNITS]
        for a, b in combinations(range(len(each)), 2):
            other = each.index_copy(0, torch.tensor([a, b], dtype=torch.int64, device=each.device), each[[b, a]])
            values.append((f"markers {a} and {b} seem to be exchanged", other.flatten()[None]))
        for words, other in values:
            undone = torch.zeros_like(data.y)
            undone[-1:] = other - y
            yield words, seen._replace(error=seen.error + seen.numbers.of_table(data.in_numbers(undone)))
        turning = torch.tensor(self.placed.registration.geometry.chain.periodic, dtype=torch.bool, device=HOST)
        q = table.q[row]
        joints = {
            "its joint values seem to be degrees as radians": torch.where(turning, q * pi / 180, q),
            "its joint values seem to be converted to radians twice": torch.where(turning, q * 180 / pi, q),
            "it seems to have been measured at the joint values of the row before": table.q[row - 1],
        }
        before, noise = self._told(data.rows(torch.arange(len(data.x) - 1, device=HOST)))
        others = self.around(with_joints(table.rows([row] * len(joints)), torch.stack([*joints.values()])))[0]
        for number, text in enumerate(joints):
            own, own_noise = self._told(others.rows(torch.tensor([number], dtype=torch.int64, device=HOST)))
            yield text, self._seen(before.joined(own), [*noise, *own_noise])

    def _told(self, data: TangentData) -> tuple[Numbers, list[Tensor]]:
        """What rows tell, and the noise of every part."""
        return data.numbers, data.numbers.blocks_of_table(data.told.weighted_noise(self.scales))

    def _seen(self, numbers: Numbers, noise: Sequence[Tensor]) -> Seen:
        """Rows as the process predicts them."""
        at = self.process.expected(numbers)
        return Seen(numbers, numbers.target - at.mean, numbers.add_blocks(at.covariance, noise))

    def around(self, others: Any) -> tuple[TangentData, Callable[[], list[Hypothesis]]]:
        """Rows of the campaign around the places of the model, and what may change of robot, tool and devices.

        MeasurementError for devices that it does not know.
        """
        known = self.placed.data
        unknown = set(others.device_names) - set(known.device_names)
        if unknown:
            fix = "they are judged once a model holds some of them"
            expected, got = few(sorted(set(known.device_names))), few(sorted(unknown))
            raise MeasurementError.of("the set-ups and devices of rows", expected=expected, got=got, fix=fix)
        anchors = known.rows([int(part.rows[0]) for part in rows_of_one_kind(known)])
        whole = joined_tables([anchors, others])
        placed, data = self.placed.beside(whole, self.data)
        index = torch.arange(len(anchors), len(whole), device=HOST)
        rows = data.rows(index)
        return rows, lambda: changes_of(rows, placed.placement.hypotheses(data, CHANGE), index)

    def _errors(self) -> tuple[Numbers, Tensor]:
        """The markers, or the origins of poses, at the target, and (T r, T r) what of their errors counts.

        Without a measuring device rigid motions of all of them do not.
        """
        q, shifts = self.asked[1], self.data.shared.shape[2]
        at = replace(self.data, nominal=self.data.nominal.typical, x=q, shared=None, observe=None, beside=None)
        A, points = Bodies(self.placed.lever).averaging(at.points), at.points.unflatten(1, (-1, 3))
        nothing, S = points.new_zeros(len(q), len(A)), torch.nn.functional.pad(A @ at.sensitivities, (0, shifts))
        own = {"target": nothing, "S": S, "J": A @ at.jacobian, "A": A.expand(len(q), *A.shape)}
        numbers = Numbers.of(q, at.points, torch.ones_like(nothing, dtype=torch.bool), **own)
        compared = torch.eye(nothing.numel(), dtype=S.dtype, device=S.device)
        if self.placed.free:
            B = (A @ frame_slopes(points, points.mean((0, 1)))).flatten(0, 1)
            compared -= B @ torch.linalg.pinv(B)
        return numbers, compared


def with_joints(table: Any, q: Tensor) -> Any:
    """Rows of one kind at other joint values (N, n)."""
    return with_attributes(table.parts[0], q=q)


def _flags(values: Sequence[bool]) -> Tensor:
    return torch.tensor(values, dtype=torch.bool, device=HOST)


def _freedom(data: TangentData, row: int) -> int:
    """Degrees of freedom of the bodies that a row shows."""
    return int(data.noise_model.freedom[row][data.noise_model.seen[row]].sum())


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
