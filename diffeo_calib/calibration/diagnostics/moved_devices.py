"""Did something move during the measurements? The tracker's tripod, the robot's foot, a marker.

If something moved at a change point k, all rows from k on are seen from another base, or with other markers:
r = B_k u + e with the effects B_k of the rows, zero before k, and unknowns u, six of the base or three of every marker.
With C the covariance of a geometric calibration (its prior and its noise), twice the gain in log likelihood by the best
u is

    gain_k = g^T H^-1 g,    g = B_k^T C^-1 r,    H = B_k^T C^-1 B_k.

If nothing moved and the robot had geometric errors only, it would be chi-squared with one degree of freedom per
unknown. The gains of all k are sums of the same blocks. Since a robot has other errors too, the best change is then
subtracted from the measurements and the scales of the full model are selected again: something moved if the log
likelihood rises by far. With these scales the full model tells row and cause.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.selection import SEARCH_LIMITS, Selection, select
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import sentence
from diffeo_calib.regression.cholesky import CholeskyRegression
from diffeo_calib.robots.se3 import skew

RIDGE = 1e-9
"""Relative size of the diagonal that keeps H invertible where rows do not determine all unknowns."""


@dataclass(frozen=True)
class ChangeLimits:
    """When a change point is examined, and when it is reported.

    Args:
        fewest_rows: smallest number of rows on either side of a change point.
        examined_gain: gain over a geometric calibration from which a change point is examined.
        reported_gain: twice the gain in log likelihood of the full model from which it is reported.
        other_markers: a single marker moved if some other marker moved by less than this share of its motion.
        decisive_evidence: difference of the Bayesian information criteria from which one cause is named alone, 20 to 1.
        iterations: of the search for scales with the change subtracted; enough for the noise to fall.
    """

    fewest_rows: int = 5
    examined_gain: float = 35.0
    reported_gain: float = 35.0
    other_markers: float = 0.5
    decisive_evidence: float = 6.0
    iterations: int = 10


LIMITS = ChangeLimits()
BASE, MARKERS = "the measuring device or the robot's base", "a marker or the tool"


class ChangePoint(NamedTuple):
    """The most likely change point.

    Args:
        row: the first row after it, in the order of measurement. gain: see above. change: (U,) the unknowns u.
        effects: (N, m, U) derivatives of all rows by the unknowns.
    """

    row: int
    gain: float
    change: Tensor
    effects: Tensor

    @property
    def motion(self) -> Tensor:
        """(N, m) displacement of every row by the change, m."""
        return self.effects @ self.change


def moved_devices(
    numbers: Tensor,
    data: TangentData,
    centre: Hyperparameters,
    selection: Selection,
    *,
    seed: int = 0,
    limits: ChangeLimits = LIMITS,
) -> tuple[str | None, bool]:
    """Whether the base or markers seem to have moved, judged by the rows on which the scales were selected.

    Args:
        numbers: (N,) numbers of the rows; their order is that of the measurements.
        data: the measurements. centre: default scales. selection: the selected scales. seed: draws the rows.
        limits: when a change point is examined and reported.

    Returns:
        a sentence with the row, the distance, and what to do, if something moved; and whether Ctrl-C ended the
        examination.
    """
    rows, some = data.sample(SEARCH_LIMITS.poses, SEARCH_LIMITS.coordinates, seed)
    if len(rows) < 4 * limits.fewest_rows or selection.likelihood is None:
        return None, False
    order = numbers[rows].argsort()
    scales, gain, interrupted = _scales_without_change(some, order, centre, selection, seed=seed, limits=limits)
    if scales is None:
        return None, interrupted
    best, what = _most_probable(some, order, scales, limits)
    text = sentence(
        f"{what} near row {int(numbers[rows[order[best.row]]])}",
        expected="one set-up for all rows, in the order of their numbers",
        got=f"a log likelihood that is {gain:.0f} higher with a change at this row",
        fix="check what happened then; name the set-ups in a column (`session`), or use the rows before or after it",
    )
    return text, False


def _scales_without_change(
    data: TangentData,
    order: Tensor,
    centre: Hyperparameters,
    selection: Selection,
    *,
    seed: int,
    limits: ChangeLimits,
) -> tuple[Hyperparameters | None, float, bool]:
    """Scales of the measurements without the best change, the gain in log likelihood, and whether Ctrl-C came.

    The scales are None if no change gains enough.
    """
    dense = data.factorised(centre.geometry_only())
    search = replace(SEARCH_LIMITS, iterations=limits.iterations)
    scales, gain = None, 0.5 * limits.reported_gain
    for effects in _causes(data).values():
        candidate = find_change_point(effects, dense, data.target, order, limits.fewest_rows)
        if candidate.gain < limits.examined_gain:
            continue
        undone = data.with_measured(_without(candidate, data.y, order))
        again = select(centre, undone, start=selection.scales, limits=search, seed=seed)
        if again.likelihood is None:
            return None, 0.0, again.interrupted
        risen = again.likelihood - (selection.likelihood or 0.0)
        if risen > gain:
            scales, gain = again.scales, risen
    return scales, gain, False


def _most_probable(
    data: TangentData, order: Tensor, scales: Hyperparameters, limits: ChangeLimits
) -> tuple[ChangePoint, str]:
    """The most probable change under the full model, whose scales are those without a change; and its words."""
    dense, causes = data.factorised(scales), _causes(data)
    # A base that is shifted without being turned needs three unknowns, as a marker does.
    hypotheses = [*causes.items(), (BASE, causes[BASE][..., :3])]
    found = [
        (name, find_change_point(effects, dense, data.target, order, limits.fewest_rows))
        for name, effects in hypotheses
    ]
    return _told_apart(found, len(order), limits)


def _causes(data: TangentData) -> dict[str, Tensor]:
    """What may move, and its effects on all rows."""
    base = _base_motions(data.points.unflatten(1, (-1, 3)))
    markers = _shifts(data.nominal.geometry.marker_poses(data.x)[..., :3, :3])
    if data.slopes is not None:
        base, markers = data.slopes @ base, data.slopes @ markers
    kinds = data.noise_model.row_kinds
    if kinds is not None:
        base[kinds > 0] = 0.0  # a ball in a socket does not show where the device of other rows stands
    return {BASE: base, MARKERS: markers}


def _told_apart(found: list[tuple[str, ChangePoint]], rows: int, limits: ChangeLimits) -> tuple[ChangePoint, str]:
    """The most probable change by the Bayesian information criterion, and what moved how far.

    Both causes are named if the criterion prefers neither decisively: a tool that hardly turns moves with the base.
    """

    def evidence(hypothesis: tuple[str, ChangePoint]) -> float:
        return hypothesis[1].gain - len(hypothesis[1].change) * log(rows)

    first, best = max(found, key=evidence)
    other = max((one for one in found if one[0] != first), key=evidence)
    what, distance = _words(best, first, limits)
    if evidence((first, best)) - evidence(other) < limits.decisive_evidence:
        what = f"{BASE}, or {MARKERS} (these rows do not tell which),"
    return best, f"{what} seems to have moved by about {1e3 * distance:.2g} mm"


def _without(change: ChangePoint, y: Tensor, order: Tensor) -> Tensor:
    """Measured coordinates (N, m) with the change subtracted from all rows after its change point, m."""
    after, y = order[change.row :], y.clone()
    y[after] -= change.motion[after]
    return y


def _words(change: ChangePoint, cause: str, limits: ChangeLimits) -> tuple[str, float]:
    """What moved, and how far, m."""
    distances = change.motion.unflatten(1, (-1, 3)).norm(dim=-1).median(0).values  # of every marker
    if cause == BASE:
        return cause, float(distances[distances > 0].median())
    distance = float(distances.max())
    single = float(distances.min()) < limits.other_markers * distance
    return f"marker {int(distances.argmax())}" if single else cause, distance


def find_change_point(
    effects: Tensor, dense: CholeskyRegression, target: Tensor, order: Tensor, fewest_rows: int = LIMITS.fewest_rows
) -> ChangePoint:
    """The most likely change point.

    Args:
        effects: (N, m, U) derivatives of the rows by the unknowns. dense: their covariance. target: (N, m) m.
        order: (N,) row numbers in the order of measurement.
        fewest_rows: smallest number of rows on either side.
    """
    n, m, unknowns = effects.shape
    each = torch.arange(n, device=effects.device)
    columns = effects.new_zeros(n, m, n, unknowns)
    columns[each, :, each] = effects
    solved = dense.solve(columns.view(n, m, n * unknowns)).view(n, m, n, unknowns)
    blocks = torch.einsum("imu,imjv->ijuv", effects, solved)[order][:, order]
    H = blocks.flip(0, 1).cumsum(0).cumsum(1).diagonal().movedim(-1, 0)  # (N, U, U) of the last 1 ... N rows
    g = torch.einsum("imu,im->iu", effects, dense.mu(target))[order].flip(0).cumsum(0)
    H = H + RIDGE * H[-1].diagonal().amax() * torch.eye(unknowns, dtype=H.dtype, device=H.device)
    u = (torch.linalg.pinv(H, hermitian=True) @ g[..., None])[..., 0]  # noise-free rows may leave H singular
    gains = (g * u).sum(1)[fewest_rows - 1 : n - fewest_rows]
    count = int(gains.argmax()) + fewest_rows  # rows after the change point
    return ChangePoint(n - count, float(gains.max()), u[count - 1], effects)


def _base_motions(points: Tensor) -> Tensor:
    """Shift and turn about the points' centre: (N, P, 3) -> (N, 3 P, 6)."""
    arms = points - points.mean((0, 1))
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(*points.shape[:2], 3, 3)
    return torch.cat([eye, -skew(arms)], dim=-1).flatten(1, 2)


def _shifts(rotations: Tensor) -> Tensor:
    """Shifts of every marker in its tip's frame: (N, P, 3, 3) -> (N, 3 P, 3 P)."""
    own = torch.eye(rotations.shape[1], dtype=rotations.dtype, device=rotations.device)
    return torch.einsum("npab,pk->npakb", rotations, own).flatten(3).flatten(1, 2)
