"""Did something move while the robot was being measured? The tracker's tripod, the robot's foot, a marker.

From some row k on everything is then seen from another base, or at other places on the tool: r = B_k u + e with the
rows' effects B_k, zero before k, and unknowns u, six of the base or three of every marker. With C the covariance of a
geometric calibration (its prior and its noise), twice the gain in log likelihood by the best u is

    gain_k = g^T H^-1 g,    g = B_k^T C^-1 r,    H = B_k^T C^-1 B_k,

chi-squared with as many degrees of freedom as unknowns if nothing moved and geometry were all. All k are sums of the
same blocks. Since it is not all, the best break is then taken out of the data and the scales of the full model are
selected again: something moved if that is by far the more likely.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.selection import SUBSET_COORDINATES, SUBSET_POSES, Selection, select
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import DiffeoCalibWarning, sentence
from diffeo_calib.regression.cholesky import CholeskyRegression
from diffeo_calib.robots.se3 import skew

FEWEST_ROWS = 5
"""Rows on both sides of a break at least."""
SUSPICIOUS = 35.0
"""Gain over a geometric calibration from which a break is looked into."""
ALONE = 0.5
"""A marker moved by itself if another moved by less than this part of it."""
ITERATIONS = 10
"""Of the search for scales then: enough to see noise fall."""
CERTAIN = 35.0
"""Twice the gain in log likelihood of the full model from which a break is reported."""


class Break(NamedTuple):
    """The likeliest break.

    Args:
        row: the row after it, in the order of measurement. gain: see above. change: (U,) the unknowns.
        effects: (N, m, U) their effects on every row.
    """

    row: int
    gain: float
    change: Tensor
    effects: Tensor

    @property
    def moved(self) -> Tensor:
        """(N, m) what the change would do to every row, m."""
        return self.effects @ self.change


def warn_of_breaks(
    numbers: Tensor, evidence: TangentData, centre: Hyperparameters, selection: Selection, seed: int = 0
) -> bool:
    """Warn if base or markers seem to have moved during the session, judged by the rows that scales were selected on.

    Args:
        numbers: (N,) of the rows, in the order of which they were measured. evidence: the rows.
        centre: default scales. selection: the selected ones. seed: draws the rows.

    Returns:
        whether Ctrl-C ended it.

    Warns:
        DiffeoCalibWarning: with the row, how far, and what to do.
    """
    rows, some = evidence.sample(SUBSET_POSES, SUBSET_COORDINATES, seed)
    if len(rows) < 4 * FEWEST_ROWS or selection.likelihood is None:
        return False
    model, order = some.linearised(), numbers[rows].argsort()
    dense = model.factorised(centre.geometric())
    base = _base_motions(model.z.unflatten(1, (-1, 3)))
    tip = _shifts(evidence.nominal.geometry.poses(some.x)[:, :3, :3], evidence.sensor.markers)
    best, gain = None, 0.5 * CERTAIN
    for effects in (base, tip):
        candidate = find_break(effects, dense, model.target, order)
        if candidate.gain < SUSPICIOUS:
            continue
        y = some.y.clone()
        y[order[candidate.row :]] -= candidate.moved[order[candidate.row :]]
        again = select(centre, replace(some, y=y), start=selection.scales, iterations=ITERATIONS, seed=seed)
        if again.likelihood is None:
            return again.interrupted
        if again.likelihood - selection.likelihood > gain:
            best, gain = candidate, again.likelihood - selection.likelihood
    if best is None:
        return False
    sizes = best.moved.unflatten(1, (-1, 3)).norm(dim=-1).median(0).values  # of every marker
    what, size = "the measuring device or the robot's base", float(sizes.median())
    if best.effects is not base:
        what, size = "a marker or the tool", float(sizes.max())
        if float(sizes.min()) < ALONE * size:
            what = f"marker {int(sizes.argmax())}"
    text = sentence(
        f"{what} seems to have moved by about {1e3 * size:.2g} mm near row {int(numbers[rows[order[best.row]]])}",
        expected="one set-up for all rows, in the order of their numbers",
        got=f"a log likelihood that is {gain:.0f} better with a change there",
        fix="look at what happened then; calibrate with the rows before or after it, or measure again",
    )
    warnings.warn(text, DiffeoCalibWarning, stacklevel=4)
    return False


def find_break(effects: Tensor, dense: CholeskyRegression, target: Tensor, order: Tensor) -> Break:
    """The likeliest break.

    Args:
        effects: (N, m, U) derivative of the rows by the unknowns. dense: their covariance. target: (N, m) m.
        order: (N,) the rows in the order in which they were measured.
    """
    n, m, unknowns = effects.shape
    columns = torch.zeros(n, m, n, unknowns, dtype=effects.dtype)
    columns[torch.arange(n), :, torch.arange(n)] = effects
    solved = dense.solve(columns.view(n, m, n * unknowns)).view(n, m, n, unknowns)
    blocks = torch.einsum("imu,imjv->ijuv", effects, solved)[order][:, order]
    H = blocks.flip(0, 1).cumsum(0).cumsum(1).diagonal().movedim(-1, 0)  # (N, U, U) of the last 1 ... N rows
    g = torch.einsum("imu,im->iu", effects, dense.mu(target))[order].flip(0).cumsum(0)
    H = H + 1e-9 * H[-1].diagonal().amax() * torch.eye(unknowns, dtype=H.dtype)
    u = torch.linalg.solve(H, g)
    gains = (g * u).sum(1)[FEWEST_ROWS - 1 : n - FEWEST_ROWS]
    count = int(gains.argmax()) + FEWEST_ROWS  # rows after the break
    return Break(n - count, float(gains.max()), u[count - 1], effects)


def _base_motions(points: Tensor) -> Tensor:
    """Shift and turn about the points' centre: (N, P, 3) -> (N, 3 P, 6)."""
    arms = points - points.mean((0, 1))
    eye = torch.eye(3, dtype=points.dtype).expand(*points.shape[:2], 3, 3)
    return torch.cat([eye, -skew(arms)], dim=-1).flatten(1, 2)


def _shifts(rotations: Tensor, markers: int) -> Tensor:
    """Of every marker in the tip's frame: (N, 3, 3) -> (N, 3 P, 3 P)."""
    own = torch.eye(markers, dtype=rotations.dtype)
    return torch.einsum("nab,pk->npakb", rotations, own).flatten(3).flatten(1, 2)
