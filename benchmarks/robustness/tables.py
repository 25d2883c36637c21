"""Fuzzing of measurement tables: cells, rows, columns, encodings and options that are wrong in one or two ways.

    python benchmarks/robustness/tables.py --count 5000

Every table is read and registered. Where that is twice as far from the truth of the simulated arm as it is without the
mutation, and for every twentieth table, the arm is calibrated whole. A mutation is silently wrong if there was no
warning and no row that looks wrong, and if the model at held-out configurations

* has twice the RMS error of the model of the unchanged table, or
* is beyond 4 claimed deviations in more than 1 % of the coordinates above the share of the unchanged table.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from fuzzing import Work, run
from table_mutations import MUTATIONS, ROWS, Sheet
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.plausibility import check_deviations, check_joints, check_limits, registered
from diffeo_calib.measurements.csv_files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

TEST_ROWS, WHOLE_EVERY = 200, 20


@dataclass(frozen=True)
class Base:
    """The simulated arm, its table, and how far its models are from the truth."""

    robot: dc.Chain
    text: str
    q: Tensor
    truth: Tensor
    registered_rms: float
    rms: float
    beyond: float


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
    known = Base(arm.nominal, text, q, truth, _rms(first.points(q), truth), 0.0, 0.0)
    rms, beyond = _errors(known, dc.calibrate(arm.nominal, data).model)
    return replace(known, rms=rms, beyond=beyond)


def _rms(points: Tensor, truth: Tensor) -> float:
    return float((points - truth).square().sum(-1).mean().sqrt())


def _errors(known: Base, model: dc.CalibratedKinematics) -> tuple[float, float]:
    """RMS distance to the truth, m, and the share of coordinates beyond 4 claimed deviations."""
    mean, covariance = model.predict(known.q, noise=False)
    deviations = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    return _rms(mean, known.truth), float(((mean - known.truth).abs() > 4 * deviations).double().mean())


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


def tried(sheet: Sheet, whole: bool) -> str:
    """Read, register and perhaps calibrate; what is wrong with the model, or nothing."""
    known, content = base(), sheet.content
    data = _read(content, sheet.options)
    check_joints(known.robot, data)
    found = registered(known.robot, data)
    check_deviations(data, found)
    check_limits(known.robot, data)
    near = _rms(found.geometry.points(known.q), known.truth) < 2 * known.registered_rms
    if near and not whole:
        return ""
    result = dc.calibrate(known.robot, data)
    rms, beyond = _errors(known, result.model)
    if rms < 2 * known.rms and beyond < known.beyond + 0.01:
        return ""
    if result.outliers:  # the rows that look wrong are named
        return ""
    usual = f"{1e3 * known.rms:.3f} mm, {known.beyond:.3f}"
    return f"RMS error {1e3 * rms:.3f} mm, share beyond 4 deviations {beyond:.3f}; unchanged table: {usual}"


def case(seed: int) -> tuple[str, Work]:
    """The table of a seed."""
    name, sheet = mutated(seed)
    return name, lambda: tried(sheet, whole=seed % WHOLE_EVERY == 0)


if __name__ == "__main__":
    run("tables.py", case, __doc__, 5000)
