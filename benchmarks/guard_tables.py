"""Measured robots, and simulated tables with wrong rows: records of guard.py, see guard_verbs.py."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from guard_kinds import JUDGED, TRAIN, Robot
from guard_verbs import Record, covered, judged, rms, timed
from robot_data import BUILT_IN, read
from sockets import read as read_sockets

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm

SIZES, SPLITS, ALL_ROWS, ALL_SPLITS = (30, 60, 150), 5, 442, 2
AGAIN_SIZES, DRAWS, OLD_ROWS = (5, 10, 20, 60), 3, 200
SERIES = {"UR10 D": "measurements_iso_cubes.csv", "UR10 A": "measurements_grid_900.csv"}
SOCKETS = {"panda_3": (3, 3), "kuka_14": (2, 3)}
"""Robots that a ball in sockets measured -> every how many rows take part, and how many places are left out."""
SHARES, SIZES_MM, WRONG_ROWS = (0.02, 0.05, 0.2), (2.0, 20.0), 120


@cache
def series(name: str, folder: Path) -> tuple[dc.Tree, dc.Measurements]:
    """A table of the UR10 or of the Franka."""
    own = "franka_fr3" if name == "Franka" else "ipa_ur10"
    entries = BUILT_IN[own] if name == "Franka" else {**BUILT_IN[own], "csv": SERIES[name]}
    found = read(folder / own, entries)
    return found.robot, found.measurements


def drawn_rows(count: int, some: int, seed: int) -> tuple[list[int], list[int]]:
    """Numbers of random rows, and of all others."""
    order = np.random.default_rng([seed, 35]).permutation(count).tolist()
    return order[:some], order[some:]


def of_measured(model: Any, test: dc.Measurements) -> Record:
    """Errors and regions of measured positions."""
    mean, covariance = model.predict(test.q)
    errors = test.points - mean
    own = {"error": 1e3 * rms(errors), "new": float(covered(errors, covariance).double().mean())}
    return own | {"said": float(covariance.diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt()) / rms(errors)}


def calibrated(name: str, rows: int, split: int, folder: Path) -> Iterator[Record]:
    """A table of the UR10: some rows of 70 %, judged on the others; a fold of the Franka's."""
    robot, data = series(name, folder)
    if name == "Franka":
        train, test = list(data.folds(SPLITS, 0))[split]
    else:
        train, test = data.split(0.7, split)
        train = train.rows(drawn_rows(len(train), rows, split)[0])
    result, seconds = timed(lambda: dc.calibrate(robot, train))
    case: Record = {"case": f"{name}, {rows} rows" if rows else name, "arm": split}
    yield {"verb": "calibrate"} | case | seconds | {"rows": len(train)} | of_measured(result.model, test)
    found, seconds = timed(lambda: dc.evaluate(result.model, test))
    yield {"verb": "evaluate"} | case | seconds | {"error": 1e3 * found.rms}


@cache
def old_model(old: str, folder: Path) -> Any:
    """The model of a series of the UR10."""
    robot, before = series(old, folder)
    return timed(lambda: dc.calibrate(robot, before.rows(drawn_rows(len(before), OLD_ROWS, 0)[0])))[0].model


def again(old: str, rows: int, folder: Path) -> Iterator[Record]:
    """A model of one series of the UR10 that meets a few rows of the other."""
    new = next(name for name in SERIES if name != old)
    (_, data), model = series(new, folder), old_model(old, folder)
    for draw in range(DRAWS):
        some, others = drawn_rows(len(data), rows, draw)
        table, test = data.rows(some), data.rows(others[:400])
        case: Record = {"case": f"{old} to {new[-1]}, {rows} rows", "arm": draw}
        placed, seconds = timed(lambda table=table: model.registered(table))
        yield {"verb": "registered"} | case | seconds | of_measured(placed, test)
        found, seconds = timed(lambda table=table: dc.recalibrate(model, table))
        yield {"verb": "recalibrate"} | case | seconds | of_measured(found.model, test)


def left_out(name: str, place: int, folder: Path) -> Iterator[Record]:
    """A place of the block is left out: spread within its sockets, and error of the known distance, mm."""
    robot, data = read_sockets(name, folder / "mukca")
    with (folder / "mukca" / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        places = [row["place"] for row in csv.DictReader(file)]
    gone = list(dict.fromkeys(places))[place]
    train = [k for k, own in enumerate(places) if own != gone][:: SOCKETS[name][0]]
    result, seconds = timed(lambda: dc.calibrate(robot, data.rows(train)))
    test = data.rows([k for k, own in enumerate(places) if own == gone])
    case: Record = {"case": name, "arm": place}
    found, spent = timed(lambda: dc.evaluate(result.model, test))
    distance = float(np.mean([abs(own.error) for own in found.distances]))
    yield {"verb": "calibrate"} | case | seconds | {"rows": len(train), "distance": 1e3 * distance}
    yield {"verb": "evaluate"} | case | spent | {"error": 1e3 * found.rms}


def contaminated(seed: int, share: float, size_mm: float) -> Iterator[Record]:
    """Rows of one marker, some of which are wrong in a random direction."""
    arm, rng = SimulatedArm(seed), np.random.default_rng([seed, 36])
    q, points = arm.measure(WRONG_ROWS, seed=seed + 1)
    wrong = rng.permutation(WRONG_ROWS)[: round(share * WRONG_ROWS)]
    away = torch.from_numpy(rng.standard_normal((len(wrong), 1, 3)))
    points[wrong] += 1e-3 * size_mm * torch.nn.functional.normalize(away, dim=-1)
    result, seconds = timed(lambda: dc.calibrate(arm.nominal, dc.Measurements(q, points, arm.nominal.joint_names)))
    robot = Robot(arm.nominal, {}, arm.sample(JUDGED, seed=seed + 900), {TRAIN: arm.true_points})
    case = f"{100 * share:.0f} % of rows off by {size_mm:.0f} mm"
    found = {int(own.row) for own in result.outliers}
    named = {"named": len(found & set(wrong.tolist())), "alarms": len(found - set(wrong.tolist()))}
    yield (
        {"verb": "calibrate", "case": case, "arm": seed, "rows": WRONG_ROWS}
        | seconds
        | named
        | judged(robot, result.model, TRAIN)
    )
