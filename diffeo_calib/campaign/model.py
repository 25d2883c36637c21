"""State of knowledge of a campaign: places, scales and the posterior of its accepted rows, and the last rows."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import inf, pi
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import LIMITS as SCALE_LIMITS
from diffeo_calib.calibration.choose_scales import choose_scales, noise_of_few, variance_ratio
from diffeo_calib.calibration.diagnostics.moved_devices import Cause, causes_of
from diffeo_calib.calibration.placing.place import Placed, place
from diffeo_calib.calibration.planning.candidates import candidates, ranges_around
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.campaign.certainty import limit_of, scales_deviation
from diffeo_calib.campaign.posterior import Posterior, Rows, Seen
from diffeo_calib.campaign.verdicts import LIMITS, Verdict, exchanged, find_change, measure
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning, InputError, MeasurementError, few
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.fitting.result import silent
from diffeo_calib.measurements.bodies import bodies_of
from diffeo_calib.measurements.observations import joined_tables
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.set_ups import frame_slopes
from diffeo_calib.sensors.tables import rows_of_one_kind

MOST_COORDINATES = 4500
"""Measured numbers of a posterior: of more rows a random sample stands for all."""
UNITS = ((1e-3, "1000 times too large: mm as m?"), (1e3, "1000 times too small: m as mm?"))


class Around(NamedTuple):
    """Rows around the places of a model, what may change of their devices, and (N,) where they are among these."""

    data: TangentData
    devices: Callable[[], list[Cause]]
    index: Tensor

    def causes(self) -> list[Cause]:
        """Changes of robot, tool and devices that are tested."""
        devices = [one._replace(effects=one.effects[self.index]) for one in self.devices()]
        return [one for one in (*causes_of(self.data), *devices) if bool((one.effects != 0).any())]


@dataclass(eq=False)
class CampaignModel:
    """Places and scales of some accepted rows, and the posterior of all of them but the last.

    Args:
        placed: geometry and devices. data: the rows they were found with. scales: of the model.
        selected: accepted rows that the scales were selected with. count: those of this model.
        deviation: of the log expected error by uncertain scales; infinite where they are not selected.
        seen: rows of the campaign at that time. asked: candidates (M, n) and target (T, n), rad or m.
        posterior: of the accepted rows but the last ones. window: numbers of the last rows.
        last: these, as the posterior predicts them. taken: (W,) boolean: those that were accepted.
        compared: see :func:`_compared`. ratios: of accepted rows, see :attr:`typical`.
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
    posterior: Posterior
    window: list[int]
    last: Seen
    taken: Tensor
    compared: Tensor
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
        if ratio > SCALE_LIMITS.variance_ratio:  # around wrong places all later rows would be wrong
            expected, got = "squared errors of single rows as the others predict them", f"{ratio:.2g} times that"
            fix = "measure more rows, then the model is made"
            raise MeasurementError.of("the first rows do not fit together yet", expected=expected, got=got, fix=fix)
        found, data = chosen.selection.scales, chosen.data
        later: Any = None
        counts = 0 if scales is None and first else len(numbers), inf, len(numbers), len(table)
        made = cls(placed, data, found, *counts, asked, later, [], later, later, later, [], later).rebuilt(
            table, verdicts
        )
        if certain and known is None:
            made.deviation = scales_deviation(data, found, made.target, made.compared)
        return made

    def rebuilt(self, table: Any, verdicts: Sequence[Verdict]) -> CampaignModel:
        """The same places and scales with the posterior of the rows that are accepted now, of devices that it knows."""
        placed, names = set(self.placed.data.device_names), table.device_names
        judged = [one for one in verdicts if names[one.row] in placed]
        accepted = [one.row for one in judged if one.accepted]
        first = accepted[(len(accepted) + 1) // 2]  # the others hold what is known
        window = [one.row for one in judged[-LIMITS.window :] if one.row >= first]
        old = [row for row in accepted if row not in window]
        known = self.placed.data.line_numbers.tolist()
        place_of = {row: number for number, row in enumerate(known)}
        mine = torch.tensor([place_of[row] for row in old if row in place_of], dtype=torch.int64, device=HOST)
        _, some = self.data.rows(mine).sample(len(mine), MOST_COORDINATES, 0)
        rows = Rows.of(some, self.scales)
        later = [row for row in old if row not in place_of]
        if later:
            rows = Rows.joined(rows, Rows.of(self.around(table, later).data, self.scales))
        asked = self._asked(table)
        posterior = Posterior(rows, asked)
        last = posterior.see(Rows.of(self.around(table, window).data, self.scales))
        taken = _flags([verdicts[row].accepted for row in window])
        own = {"posterior": posterior, "window": window, "last": last, "taken": taken, "ratios": list(self.ratios)}
        own |= {"compared": _compared(self.placed, asked[0]), "open": self.placed.sees(self.like, self.asked[0])}
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

    @property
    def _covariance(self) -> Tensor:
        """Covariance (T r, T r) of the errors over the target, m^2."""
        J = self.compared
        return J @ self.known(J.shape[1]) @ J.T

    def known(self, size: int | None = None) -> Tensor:
        """Covariance of the target and then of the candidates by all accepted rows, the first ``size`` numbers, m^2."""
        whole, mine = self.posterior.known[:size, :size], self.taken[self.last.rows.owner]
        cross = self.last.asked[mine, :size]
        return whole - cross.T @ torch.linalg.solve(self.last.covariance[mine][:, mine], cross)

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
            around = self.around(table, self.window)
        except DiffeoCalibError:
            self.window.pop()
            raise
        last = len(self.window) - 1
        seen = Seen.joined(
            self.last, self._seen(around.data.rows(torch.tensor([last], dtype=torch.int64, device=HOST)))
        )
        known = _flags([*(verdicts[number].accepted for number in self.window[:-1]), False])
        found, typical = measure(seen, last, known, _freedom(around.data, last)), self.typical
        fits = found.fits(typical)
        if fits:
            self.ratios.append(found.square / chi2_above(1.0 - LIMITS.typical_share, found.freedom))
        cause = "" if fits else self._cause(table, around.data, seen, known)
        shown = self.placed.shown(table.rows([row]).parts[0])
        verdicts.append(Verdict(row, fits, fits, found.error, found.expected, cause, shown=shown, line=lines[row]))
        own = [verdicts[number] for number in self.window]
        flags = _flags([one.accepted for one in own]), _flags([not one.cause for one in own])
        how: Any = {"single": found, "typical": typical}
        change = None if cause else find_change(seen, self.window, around.causes(), flags, **how)
        if change is not None:
            change = replace(change, line=lines[change.row])
            for number in self.window:
                own, before = verdicts[number], number < change.row
                if own.change is not None or not (before or own.cause or own.decided):
                    accepted = before and bool(own.fits)
                    verdicts[number] = replace(own, accepted=accepted, change=None if before else change)
        self._move_on(seen, verdicts)

    @property
    def typical(self) -> float:
        """How large right squares are relative to what chance exceeds in a share of the rows: at least one."""
        last = sorted(self.ratios[-LIMITS.typical_rows :])
        if len(last) < LIMITS.fewest_typical:
            return LIMITS.at_first
        return max(1.0, last[int(LIMITS.typical_share * len(last))])

    def _move_on(self, seen: Seen, verdicts: Sequence[Verdict]) -> None:
        """Take the first row of a full window into the posterior, if it was accepted."""
        self.taken = _flags([verdicts[row].accepted for row in self.window])
        self.last = seen
        if len(self.window) <= LIMITS.window:
            return
        index = torch.arange(len(seen.rows), device=HOST)
        row, self.last = seen.some(index[:1]), seen.some(index[1:])
        if bool(self.taken[0]):
            self.last = self.posterior.take(row, self.last)
        self.window, self.taken = self.window[1:], self.taken[1:]

    def _cause(self, table: Any, data: TangentData, seen: Seen, known: Tensor) -> str:
        """Why the last row is wrong, in words; empty if nothing that is undone makes it fit."""
        row, last, freedom = self.window[-1], len(known) - 1, _freedom(data, len(known) - 1)
        mine, visible = seen.rows.owner == last, data.visible[last]

        def fits(other: Seen, some: Tensor | None = None, freedom: int = freedom) -> bool:
            return measure(other, last, known, freedom, some).fits(self.typical, LIMITS.undone)

        y = data.y[last : last + 1]
        bodies = data.noise_model.bodies
        undone = [(f"its values seem to be {words}", factor * y) for factor, words in UNITS]
        for words, other in [*undone, *exchanged(y, bodies)]:
            error = seen.error.clone()
            error[mine] += (other - y)[0, visible]
            if fits(seen._replace(error=error)):
                return words
        for words, other in self._other_joints(table, row, seen):
            if fits(other):
                return words
        size = len(visible) // bodies
        body = (seen.rows.visible.nonzero()[:, 1] // size).masked_fill(~mine, -1)
        good = [b for b in range(bodies) if fits(seen, mine & (body != b), freedom * (bodies - 1) // bodies)]
        return f"marker {good[0]} seems to be wrong" if len(good) == 1 < bodies else ""

    def _other_joints(self, table: Any, row: int, seen: Seen) -> Iterator[tuple[str, Seen]]:
        """The last rows with other joint values of the last one, in words."""
        turning = torch.tensor(self.placed.registration.geometry.chain.periodic, dtype=torch.bool, device=HOST)
        q = table.q[row]
        joints = {
            "its joint values seem to be degrees as radians": torch.where(turning, q * pi / 180, q),
            "its joint values seem to be converted to radians twice": torch.where(turning, q * 180 / pi, q),
            "it seems to have been measured at the joint values of the row before": table.q[row - 1],
        }
        before = seen.some(torch.arange(len(seen.rows) - 1, device=HOST))
        each = self._seen(self.around(table, [row] * len(joints), torch.stack([*joints.values()])).data)
        for number, text in enumerate(joints):
            yield text, Seen.joined(before, each.some(torch.tensor([number], dtype=torch.int64, device=HOST)))

    def _seen(self, data: TangentData) -> Seen:
        """Rows as the posterior predicts them."""
        return self.posterior.see(Rows.of(data, self.scales))

    def around(self, table: Any, numbers: Sequence[int], joints: Tensor | None = None) -> Around:
        """Rows of the campaign around the places of the model; MeasurementError for devices that it does not know.

        Args:
            joints: (N, n) in place of theirs.
        """
        others = table.rows(list(numbers))
        return self._around(others if joints is None else with_joints(others, joints))

    def _around(self, others: Any) -> Around:
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
        return Around(data.rows(index), lambda: placed.placement.changes(data), index)

    def _asked(self, table: Any) -> tuple[Rows, Rows]:
        """The target, and the candidates as if they were measured like the row :attr:`like`."""
        candidates, row = self.asked[0], self.like
        rows = table.rows([int(self.placed.data.line_numbers[row])] * len(candidates))
        like = self.placed.measured_at(row, with_joints(rows, candidates), candidates)
        return self.target(self.scales), Rows.of(self._around(like).data, self.scales)

    def target(self, scales: Hyperparameters) -> Rows:
        """The places at which the robot shall be accurate."""
        q, nominal = self.asked[1], self.data.nominal.typical
        at = replace(self.data, nominal=nominal, x=q, shared=None, observe=None, beside=None).linearisation(scales)
        count, m = at.sensitivity.shape[:2]
        c = 0 if self.data.shared is None else self.data.shared.shape[2]
        nothing, seen = q.new_zeros(count, m), torch.ones(count, m, dtype=torch.bool, device=HOST)
        return Rows(at, q.new_zeros(count, m, c), q.new_zeros(count, m, m), nothing, seen)


def with_joints(table: Any, q: Tensor) -> Any:
    """Rows of one kind at other joint values (N, n)."""
    return with_attributes(table.parts[0], q=q)


def _flags(values: Sequence[bool]) -> Tensor:
    return torch.tensor(values, dtype=torch.bool, device=HOST)


def _freedom(data: TangentData, row: int) -> int:
    """Degrees of freedom of the bodies that a row shows."""
    return data.rows(torch.tensor([row], dtype=torch.int64, device=HOST)).measured_freedom


def _compared(placed: Placed, target: Rows) -> Tensor:
    """(T r, T 3 P) what of the errors over the target counts: the markers, or the origins of poses.

    Without a measuring device rigid motions of all of them do not.
    """
    count = len(target)
    whole = torch.block_diag(*bodies_of(placed.lever).averaging(target.target).expand(count, -1, -1))
    if not placed.free:
        return whole
    points = target.at.task[0].points.view(count, -1, 3)
    B = frame_slopes(points, points.mean((0, 1))).flatten(0, 1)
    return whole - whole @ B @ torch.linalg.pinv(B)
