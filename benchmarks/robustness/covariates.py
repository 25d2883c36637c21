"""Would errors that may depend on a further column help: time, temperature, direction of approach? No model has them.

    python benchmarks/robustness/covariates.py --cases ur10 --seeds 3 --out covariates.json
    python benchmarks/robustness/covariates.py --cases simulated --seeds 3 --out drifts.json

The scales of a calibration are chosen on the training rows, without the column. Then one more term of its covariance
depends on the column c, scaled to -1..1 on the training rows, with the amplitude of the largest likelihood:

    frame   shifts and turns of the measuring frame (6 columns);   joints   an offset of every joint
    field   the error of the joints that depends on all of them

each linear in c (covariance c c') or smooth (exp(-(c - c')^2 / (2 0.3^2))). `approach` gives each joint an offset with
the sign of its last motion. Held out are 30 % of the rows at random (interpolation in c), or the last third of the rows
(`later`). `shuffled` permutes the times: a control. The linear model around the geometric calibration stands for the
exact one, from which it differs by less than the noise. The simulated arm has 150 training rows and a drift of its own,
in the whole campaign: the frame moves, or joint 2, by as much at 0.75 m; errors are those of the true positions.

Fields of a record: `series`, `drift_mm`, `split`, `seed`, `column`, `form`, `poses`; `ratio` twice the log of the
likelihood ratio; RMS errors `without_um` the term, `known_um` with c given for the held-out rows, and `unknown_um` with
the term in the fit and not in the prediction; `covered_without`, `covered_known` shares in the 95 % regions, which
here are those of Gaussian noise.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOMS = Path(__file__).parents[1]
sys.path[:0] = [str(ROOMS), str(ROOMS / "real_robots")]  # for the modules that benchmarks share

import argparse
import csv
import warnings
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime

import harness
import torch
from gear_lines import SERIES, tangent, ur10
from harness import Record
from held_out import covered, rms_mm
from robot_data import data_folder
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.process.scales import COUPLED_PROFILE
from diffeo_calib.robots.simulated_arm import SimulatedArm
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.set_ups import frame_slopes

FORMS = tuple(f"{part}, {shape}" for part in ("frame", "joints", "field") for shape in ("linear", "smooth"))
SMOOTH_RANGE = 0.3
AMPLITUDES_M = tuple(3e-6 * 2**k for k in range(8))
"""RMS displacement of one column at c = 1."""
FACTORS = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Amplitudes of the field, relative to its own."""
ROWS, LEVER_M, MOVED_JOINT = 150, 0.75, 1
DRIFTS = (("none", 0.0), ("frame", 0.05), ("joint", 0.05), ("frame", 0.2))
SMALLEST_MOTION_RAD = 1e-3
CASES = ("ur10", "simulated")
COLUMNS = (
    *("series", "drift_mm", "split", "seed", "column", "form", "poses", "ratio"),
    *("without_um", "known_um", "unknown_um", "covered_without", "covered_known"),
)


class Split:
    """The linear model of training rows, and what it predicts for held-out rows with a further covariance.

    Args:
        robot: nominal. train, test: the rows.
        truth: (M, P, 3) true positions of the held-out rows, m, if they are known.
    """

    def __init__(self, robot: Tree, train: dc.Measurements, test: dc.Measurements, truth: Tensor | None = None) -> None:
        fitted, self.scales = tangent(robot, train)
        weights = torch.cat([fitted.tails.weights, fitted.tails.weights.new_ones(len(test), train.markers)])
        places = torch.cat([train.points, test.points if truth is None else truth]).flatten(1)
        tails, q = replace(fitted.tails, weights=weights), torch.cat([train.q, test.q])
        alike = fitted.noise_model.rows(torch.arange(len(q)).clamp(max=len(train) - 1))
        self.data = TangentData(fitted.nominal, fitted.theta, q, places, alike, tails)
        noise = self.data.weighted_noise(self.scales)
        self.noise = torch.block_diag(*noise)
        self.new_noise = noise[len(train) :] if truth is None else torch.zeros_like(noise[len(train) :])
        self.prior = self.data.linearisation(self.scales).gram()
        self.rows, self.width = len(train), places.shape[1]
        self.fit = slice(0, self.rows * self.width)
        self.new = slice(self.rows * self.width, None)
        self.target = self.data.target.flatten()
        self.plain = (self.prior + self.noise)[self.fit, self.fit]
        self.likelihood = self._likelihood(self.plain)
        self.without = self.predicted(torch.zeros_like(self.prior), known=True)

    def term(self, form: str, column: Tensor) -> Tensor:
        """Covariance (N m, N m) of a form with amplitude 1: m^2 for a field, without unit for columns."""
        part, shape = form.split(", ")
        if shape == "approach":  # a column for every joint
            columns = (self._columns("joints") * column[:, None]).flatten(0, 1)
            return columns @ columns.T
        away = (column[:, None] - column) / SMOOTH_RANGE
        between = column[:, None] * column if shape == "linear" else (-0.5 * away.square()).exp()
        if part == "field":
            distances = self.data.space.squared_distances(self.data.x, self.data.x)
            scaled = torch.tensordot(self.scales.coupled_lengthscale.pow(-2), distances, dims=1)
            between = between * COUPLED_PROFILE.derivatives(scaled, 0)[0]
            columns = (self.data.jacobian * self.scales.coupled_amplitude).flatten(0, 1)
        else:
            columns = self._columns(part).flatten(0, 1)
        return (columns @ columns.T) * between.repeat_interleave(self.width, 0).repeat_interleave(self.width, 1)

    def _columns(self, part: str) -> Tensor:
        """(N, m, k) displacements of RMS 1 on the training rows."""
        points = self.data.values.unflatten(1, (-1, 3))
        centre = points[: self.rows].mean((0, 1))
        slopes = frame_slopes(points, centre) if part == "frame" else self.data.jacobian
        return slopes / slopes[: self.rows].square().sum(1).mean(0).sqrt()

    def likeliest(self, form: str, column: Tensor) -> tuple[float, Tensor]:
        """Twice the log likelihood ratio, and the covariance: zero where no amplitude is likelier than none."""
        term, best = self.term(form, column), (0.0, torch.zeros_like(self.prior))
        for amplitude in FACTORS if form.startswith("field") else AMPLITUDES_M:
            matrix = self.plain + amplitude**2 * term[self.fit, self.fit]
            ratio = 2.0 * (self._likelihood(matrix) - self.likelihood)
            if ratio > best[0]:
                best = ratio, amplitude**2 * term
            elif best[0] > 0.0:  # larger ones are less likely still
                break
        return best

    def predicted(self, further: Tensor, *, known: bool) -> tuple[float, float]:
        """RMS error of the held-out rows in um, and the share of them in the 95 % regions.

        Args:
            further: covariance of the term. known: whether it counts in the prediction.
        """
        prior = self.prior + further if known else self.prior
        factor = torch.linalg.cholesky((self.prior + further + self.noise)[self.fit, self.fit])
        across = torch.linalg.solve_triangular(factor, prior[self.fit, self.new], upper=False)
        white = torch.linalg.solve_triangular(factor, self.target[self.fit, None], upper=False)
        errors = (self.target[self.new] - (across.T @ white)[:, 0]).view(-1, self.width)
        whole = (prior[self.new, self.new] - across.T @ across).view(len(errors), self.width, len(errors), self.width)
        blocks = whole.diagonal(dim1=0, dim2=2).permute(2, 0, 1) + self.new_noise
        return 1e3 * rms_mm(errors), covered(errors, blocks)

    def _likelihood(self, covariance: Tensor) -> float:
        """Log likelihood of the training rows with this covariance of theirs, up to a constant."""
        factor = torch.linalg.cholesky(covariance)
        white = torch.linalg.solve_triangular(factor, self.target[self.fit, None], upper=False)
        return -0.5 * float(white.square().sum()) - float(factor.diagonal().log().sum())

    def record(self, name: str, form: str, column: Tensor) -> Record:
        """One form of one column."""
        ratio, further = self.likeliest(form, column)
        known, unknown = (self.predicted(further, known=known) for known in (True, False))
        errors = {"without_um": self.without[0], "known_um": known[0], "unknown_um": unknown[0]}
        shares = {"covered_without": self.without[1], "covered_known": known[1]}
        return {"column": name, "form": form, "poses": self.rows, "ratio": ratio, **errors, **shares}


def scaled(column: Tensor, rows: int) -> Tensor:
    """A column with the range -1..1 on the first rows."""
    low, high = column[:rows].min(), column[:rows].max()
    return 2.0 * (column - low) / (high - low) - 1.0


def measured_columns(path: Path) -> dict[str, Tensor]:
    """Time and temperature of a series of the UR10; the row number where the file has lost the times."""
    with path.open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines, delimiter=";"))
    stamps = [row["Timestamp"] for row in rows]
    whole = len(set(stamps)) == len(stamps)
    times = [datetime.strptime(s, "%Y%m%d%H%M%S").timestamp() for s in stamps] if whole else list(range(len(rows)))
    warmth = [float(row["measurement_temperature"].replace(",", ".")) for row in rows]
    names = ("time", "temperature") if len(set(warmth)) > 2 else ("time",)
    columns = {"time": times, "temperature": warmth}
    return {name: torch.tensor(columns[name], dtype=torch.float64) for name in names}


def approach(q: Tensor) -> Tensor:
    """Sign of the motion of every joint towards each row (N, n); zero where it has hardly moved."""
    moved = torch.diff(q, dim=0, prepend=q[:1])
    return torch.where(moved.abs() > SMALLEST_MOTION_RAD, moved.sign(), 0.0)


def real(series: str, seeds: int, folder: Path | None) -> Iterator[Record]:
    """All columns of one series of the UR10."""
    found = ur10(series, folder)
    data = dc.Measurements(found.measurements.q, found.measurements.points)
    columns = measured_columns(data_folder(folder) / "ipa_ur10" / SERIES[series])
    numbers, generator = torch.arange(len(data)), torch.Generator().manual_seed(0)
    splits = [("random", seed, *(part.line_numbers for part in data.split(0.7, seed=seed))) for seed in range(seeds)]
    splits.append(("later", 0, numbers[: 2 * len(data) // 3], numbers[2 * len(data) // 3 :]))
    for split, seed, train, test in splits:
        model, order = Split(found.robot, data.rows(train), data.rows(test)), torch.cat([train, test])
        head: Record = {"series": series, "split": split, "seed": seed}
        for name, column in columns.items():
            for form in FORMS if name == "time" else FORMS[::2]:
                yield head | model.record(name, form, scaled(column[order], len(train)))
        if series == "ur10_d":  # all rows of this series, in the order in which they were measured
            yield head | model.record("approach", "joints, approach", approach(data.q)[order])
        mixed = columns["time"][torch.randperm(len(data), generator=generator)]
        for form in FORMS[:3]:
            yield head | model.record("shuffled", form, scaled(mixed, len(train)))


def simulated(drift: str, mm: float, seed: int) -> Iterator[Record]:
    """The simulated arm: a drift that is linear in the column."""
    arm, rows = SimulatedArm(seed), ROWS * 3 // 2
    q, time = arm.sample(rows, seed=1000 + seed), torch.linspace(0.0, 1.0, rows, dtype=torch.float64)
    turned, shift = q.clone(), 1e-3 * mm * time
    if drift == "joint":
        turned[:, MOVED_JOINT] += shift / LEVER_M
    truth = arm.true_points(turned)
    if drift == "frame":
        truth = truth + shift[:, None, None] * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(truth.shape, generator=generator, dtype=truth.dtype)
    data = dc.Measurements(q, truth + arm.noise * noise)
    for split, order in (("random", torch.randperm(rows, generator=generator)), ("later", torch.arange(rows))):
        train, test = order[:ROWS], order[ROWS:]
        model = Split(arm.nominal, data.rows(train), data.rows(test), truth[test])
        head: Record = {"series": f"arm, {drift}", "drift_mm": mm, "split": split, "seed": seed}
        for form in FORMS:
            yield head | model.record("time", form, scaled(time[order], ROWS))


def measure(arguments: argparse.Namespace) -> Iterator[Record]:
    """Yield the records of the cases asked for."""
    seeds = 1 if arguments.quick else arguments.seeds
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
        if "simulated" in arguments.cases:
            for drift, mm in DRIFTS[1:2] if arguments.quick else DRIFTS:
                for seed in range(seeds):
                    yield from simulated(drift, mm, seed)
        if "ur10" in arguments.cases and not arguments.quick:
            for series in SERIES:
                yield from real(series, seeds, arguments.data)


if __name__ == "__main__":
    data = {**harness.DATA, "help": "measured robots"}
    seeds = harness.number(3, "random splits, or arms")
    harness.run(__doc__, measure, COLUMNS, cases=harness.names(CASES), seeds=seeds, data=data)
