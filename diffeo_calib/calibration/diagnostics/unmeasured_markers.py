"""Markers that nobody measured: copies of another one, and places of the nominal robot beside measured ones."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from math import inf
from typing import NamedTuple

import torch

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.likely_mistakes import residual_of
from diffeo_calib.calibration.identification.registration import spread
from diffeo_calib.common.errors import MeasurementError, few, sentence, warn_user
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree


class Unmeasured(NamedTuple):
    """A marker, what it is in words, and whether that is proved."""

    marker: int
    words: str
    proved: bool


def unmeasured_markers(robot: Tree, data: Measurements) -> Iterator[Unmeasured]:
    """Markers that copy another one, and those that the nominal robot explains although it does not explain others.

    Args:
        robot: n joints. data: N rows of one set-up.
    """
    places, turns, size = data.origins, robot.tip_poses(data.q)[..., :3, :3], spread(data.points)
    about = torch.linalg.svdvals((turns - turns[:1]).reshape(-1, 3))  # of turns about one axis the last one is 0
    turning = float(about[-1]) > gates.MOVED_RAD_M * len(turns) ** 0.5
    for one, other in combinations(range(places.shape[1]), 2):
        away = places[:, other] - places[:, one]
        away = away[~away.isnan().any(-1)]
        if len(away) < gates.STUCK_ROWS:
            continue
        shifted = bool(away.any())
        if not shifted or (turning and float((away - away.median(0).values).abs().max()) < gates.DIGITS_SHARE * size):
            words = f"marker {other} is a copy of marker {one}" + ", shifted by the same in every row" * shifted
            yield Unmeasured(other, words, proved=True)
    tips = data.bodies.tips(data.on or robot.tips[:1] * data.points.shape[1])
    if robot.n < gates.NOMINAL_JOINTS or len(set(tips)) == len(tips):
        return
    own = [_residual(robot, data, k, tip) for k, tip in enumerate(tips)]
    for k, typical in enumerate(own):
        far = max(other for other, tip in zip(own, tips, strict=True) if tip == tips[k])
        explained = gates.DIGITS_SHARE * size < far < gates.RIGHT_READING * size
        if explained and typical < min(gates.FOLLOWED * far, gates.NOMINAL_SHARE * size):
            words = f"marker {k} follows the nominal robot to {1e3 * typical:.4f} mm, another one to {1e3 * far:.3g} mm"
            yield Unmeasured(k, f"{words}: wished places", typical < gates.DIGITS_SHARE * size)


def _residual(robot: Tree, data: Measurements, marker: int, tip: str) -> float:
    """Median residual of the nominal robot for one marker, m; infinite where few rows show it."""
    seen = data.seen_bodies[:, marker]
    if int(seen.sum()) < gates.STUCK_ROWS:
        return inf
    return residual_of(robot, Measurements.of_points(data.q[seen], data.origins[seen][:, [marker]], (tip,), None))


def check_markers(robot: Tree, data: Measurements) -> None:
    """Refuse markers that are no measurements, with the proof; warn of doubtful ones."""
    for marker, words, proved in unmeasured_markers(robot, data):
        triples = data.origin.columns.triples if isinstance(data.origin, TableOrigin) else []
        numbers = data.marker_names or range(data.markers)
        names = triples[marker] if len(triples) == data.markers else [f"marker {numbers[marker]}"]
        fix = f"leave {few(names)} out: wished or computed places, or the same marker twice, are no measurements"
        if proved:
            raise MeasurementError.of(words, fix=fix)
        warn_user(sentence(words, fix=f"if they were not measured, {fix}"))
