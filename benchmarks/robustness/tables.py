"""Fuzzing of measurement tables: cells, rows, columns, encodings and options that are wrong in one or two ways.

    python benchmarks/robustness/tables.py --count 5000

Every table is read and checked, which takes milliseconds; the numbers must be those that Python's own `csv` and `float`
find in the same file, where these can read it. Only three of every hundred tables are registered, because the search
for a likely mistake takes seconds, and one of these three is calibrated whole. So is one whose registration is twice as
far from the truth of the simulated arm as it is without the mutation. An accepted mutation is silently wrong if there
was no warning and no row that looks wrong, and if the model at held-out configurations

* has twice the RMS error of the model of the unchanged table, and twice the one that it claims itself, or
* is beyond 4 claimed deviations in more than 1 % of the coordinates above the share of the unchanged table.

A constant added to a column is another zero of that joint, or another measuring frame: the truth moves with it.
"""

from __future__ import annotations

import csv
import io
import os
import tempfile
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cache
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from fuzzing import Work, run
from table_mutations import MUTATIONS, ROWS, Sheet
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.plausibility import check_joints, check_limits, registered
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

TEST_ROWS, READING_AGREEMENT = 200, 1e-12
FACTORS = {"m": 1.0, "mm": 1e-3, "rad": 1.0, "deg": np.pi / 180}


class Depth(IntEnum):
    """How far a table is tried."""

    read = 0
    registered = 1
    calibrated = 2


@dataclass(frozen=True)
class Base:
    """The simulated arm, its table, and how far its registration is from the truth."""

    robot: dc.Chain
    text: str
    q: Tensor
    truth: Tensor
    registered_rms: float

    def moved(self, by: dict[str, float]) -> Base:
        """The same arm where constants in deg and mm were added to columns: other zeros, another frame."""
        shift = [by.get(name, 0.0) for name in (*self.robot.joint_names, "x", "y", "z")]
        added = torch.tensor(shift, dtype=self.q.dtype, device=self.q.device)
        return replace(self, q=self.q + torch.deg2rad(added[:6]), truth=self.truth + 1e-3 * added[6:])


@cache
def base() -> Base:
    """Made once, for all cases."""
    arm = SimulatedArm(seed=1)
    data = dc.Measurements(*arm.measure(ROWS, seed=2), arm.nominal.joint_names)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        write_measurements(path, data, TableFormat("mm", "deg"), position=("x", "y", "z"))
        text = path.read_text()
    q = arm.sample(TEST_ROWS, seed=5)
    truth = arm.true_points(q)
    first = registered(arm.nominal, data).geometry
    return Base(arm.nominal, text, q, truth, _rms(first.points(q), truth))


@cache
def usual_errors() -> tuple[float, float, float]:
    """Those of the model of the unchanged table, see :func:`_errors`."""
    known = base()
    data = _read(known.text.encode(), {"length": "mm", "angle": "deg"})
    return _errors(known, dc.calibrate(known.robot, data).model)


def _rms(points: Tensor, truth: Tensor) -> float:
    return float((points - truth).square().sum(-1).mean().sqrt())


def _errors(known: Base, model: dc.CalibratedKinematics) -> tuple[float, float, float]:
    """RMS distance to the truth, m, the one claimed, m, and the share of coordinates beyond 4 claimed deviations."""
    mean, covariance = model.predict(known.q, noise=False)
    deviations = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    claimed = float(deviations.square().sum(-1).mean().sqrt())
    return _rms(mean, known.truth), claimed, float(((mean - known.truth).abs() > 4 * deviations).double().mean())


def mutated(seed: int) -> tuple[str, Sheet]:
    """One mutation, or two where the second can still be made."""
    rng = np.random.default_rng([seed, 0])
    sheet = Sheet([line.split(",") for line in base().text.splitlines()])
    names = []
    for k in range(1 if rng.random() < 0.8 else 2):
        mutation = MUTATIONS[int(rng.integers(len(MUTATIONS)))]
        try:
            mutation(sheet, rng)
        except (ValueError, IndexError):
            if not k:
                raise
            continue
        names.append(mutation.__name__)
    return " and ".join(names), sheet


# --- judgement ------------------------------------------------------------------------------------------------------


def _read(content: bytes, options: dict[str, str]) -> dc.Measurements:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        path.write_bytes(content)
        return dc.read_measurements(path, base().robot, ["x", "y", "z"], **options)  # pyright: ignore[reportArgumentType]


def second_reading(content: bytes, options: dict[str, str]) -> np.ndarray | None:
    """Joints and positions (N, 9) in rad and m by Python's own means; None where these cannot read the table."""
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    names, decimal = [*base().robot.joint_names, "x", "y", "z"], options.get("decimal", ".")
    try:
        lines = csv.reader(io.StringIO(content.decode(encoding)), delimiter=options["sep"])
        header, *rows = [[cell.strip() for cell in row] for row in lines if any(map(str.strip, row))]
        if any(header.count(name) != 1 for name in names):
            return None
        columns = [header.index(name) for name in names]
        values = [[float(row[column].replace(decimal, ".")) for column in columns] for row in rows]
        factors = [FACTORS[options["angle"]]] * 6 + [FACTORS[options["length"]]] * 3
    except (ValueError, LookupError, TypeError, csv.Error):
        return None
    return np.array(values).reshape(-1, 9) * factors


def misread(sheet: Sheet, data: dc.Measurements) -> str:
    """What the reader and Python's own means see differently, or nothing."""
    expected = second_reading(sheet.content, sheet.options)
    if expected is None:
        return ""
    seen = torch.cat([data.q, data.points.flatten(1)], dim=1).numpy()
    if seen.shape != expected.shape:
        return f"{len(seen)} rows were read, and {len(expected)} are in the file"
    same = np.isclose(seen, expected, rtol=READING_AGREEMENT, atol=0.0)
    return "" if same.all() else f"read {seen[~same][0]!r} for {expected[~same][0]!r}"


def tried(sheet: Sheet, depth: Depth) -> str:
    """Read, and perhaps register and calibrate; what is wrong with the numbers or the model, or nothing."""
    known, content = base().moved(sheet.moved), sheet.content
    data = _read(content, sheet.options)
    check_joints(known.robot, data)
    wrong = misread(sheet, data)
    if wrong or depth is Depth.read:
        return wrong
    found = registered(known.robot, data)
    check_limits(known.robot, data)
    near = _rms(found.geometry.points(known.q), known.truth) < 2 * known.registered_rms
    if near and depth is Depth.registered:
        return ""
    result = dc.calibrate(known.robot, data)
    (rms, claimed, beyond), (usual_rms, _, usual_beyond) = _errors(known, result.model), usual_errors()
    if rms < 2 * max(usual_rms, claimed) and beyond < usual_beyond + 0.01:
        return ""
    if result.outliers:  # the rows that look wrong are named
        return ""
    usual = f"{1e3 * usual_rms:.3f} mm, {usual_beyond:.3f}"
    return f"RMS error {1e3 * rms:.3f} mm, share beyond 4 deviations {beyond:.3f}; unchanged table: {usual}"


def case(seed: int) -> tuple[str, Work]:
    """The table of a seed."""
    name, sheet = mutated(seed)
    return name, lambda: tried(sheet, depth(seed))


def depth(seed: int) -> Depth:
    """How far the table of a seed is tried: three of every hundred are registered, one of these is calibrated."""
    return {0: Depth.calibrated, 33: Depth.registered, 66: Depth.registered}.get(seed % 100, Depth.read)


if __name__ == "__main__":
    run("tables.py", case, __doc__, 5000)
