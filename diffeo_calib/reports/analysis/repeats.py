"""Accuracy and repeatability of poses in the sense of ISO 9283, from rows that repeat a configuration.

For one pose with n >= 2 attainments at positions p_j, their mean m and the commanded position c,

    accuracy AP = |m - c|,    repeatability RP = mean(l_j) + 3 S_l,   l_j = |p_j - m|,

S_l the standard deviation of l_j. The standard asks for 30 attainments of five poses at full load and speed; fewer are
reported with their number.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.quantiles import largest_known
from diffeo_calib.kinematics.evaluation import at_payloads
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.reports.analysis.stages import Kinematics

FEWEST_REPEATS = 5
"""Measurements beyond the first of every pose from which their deviation says something about the robot."""
STANDARD_REPEATS = 30
"""Attainments of every pose that ISO 9283 asks for."""


@dataclass(frozen=True, eq=False)
class Repeats:
    """Configurations that were measured several times.

    Args:
        lines: (G,) line number of the first measurement of each. counts: (G,) measurements of each.
        repeatability: (G,) RP of each, the largest of all markers, m.
        accuracy: name of each stage -> (G,) AP of each configuration, the largest of all markers, m.
        deviation: pooled RMS distance of a measurement from the mean of its configuration, unbiased, m.
    """

    lines: Tensor
    counts: Tensor
    repeatability: Tensor
    accuracy: Mapping[str, Tensor]
    deviation: float

    @property
    def telling(self) -> bool:
        """Whether there are enough repeats for one number that speaks of the robot."""
        return int((self.counts - 1).sum()) >= FEWEST_REPEATS


def repeats_of(data: Measurements, stages: Mapping[str, Kinematics], noise: float) -> Repeats | None:
    """Accuracy and repeatability of the configurations that rows repeat; None if no row does.

    Rows that differ so much that the robot moves by more than the noise are neighbours, not repeats. Exact copies of a
    row, which no measurement gives, count once.

    Args:
        data: the rows. stages: name -> kinematics, the best one last. noise: of one measured coordinate, m.
    """
    copies = {row for _, row in data.copies()}
    data = data.rows([row for row in range(len(data)) if row not in copies])
    labels = data.groups()
    repeated = torch.bincount(labels)[labels] > 1
    if not bool(repeated.any()):
        return None
    data = data.rows(repeated)
    at_rows = {name: at_payloads(kinematics, data)(data.q).detach() for name, kinematics in stages.items()}
    predicted = {name: data.bodies.origins(found) for name, found in at_rows.items()}  # (N, B, 3) m
    *_, best = predicted.values()
    points, labels, squares, freedom = data.origins, data.groups(), 0.0, 0
    first, counts, repeatability = list[int](), list[int](), list[Tensor]()
    accuracy: dict[str, list[Tensor]] = {name: [] for name in stages}
    for label in labels.unique().tolist():
        rows = (labels == label).nonzero()[:, 0]
        middle = points[rows].nanmean(0)
        distances = (points[rows] - middle).norm(dim=-1)  # (n, B), NaN for hidden markers
        seen = (~distances.isnan()).sum(0)
        if int(seen.max()) < 2 or float((best[rows] - best[rows[:1]]).norm(dim=-1).max()) >= noise:
            continue
        variances = (distances - distances.nanmean(0)).square().nansum(0) / (seen - 1).clamp(min=1)
        repeatability.append((distances.nanmean(0) + 3.0 * variances.sqrt())[seen > 1].max())
        squares += float(distances.square().nansum())
        freedom += int((seen - 1).clamp(min=0).sum())
        first.append(int(rows[0]))
        counts.append(len(rows))
        for name, places in predicted.items():
            accuracy[name].append(largest_known((middle - places[rows].mean(0)).norm(dim=-1), 0))
    if not first:
        return None
    return Repeats(
        data.line_numbers[first],
        torch.tensor(counts, dtype=torch.int64, device=HOST),
        torch.stack(repeatability),
        {name: torch.stack(values) for name, values in accuracy.items()},
        (squares / freedom) ** 0.5,
    )
