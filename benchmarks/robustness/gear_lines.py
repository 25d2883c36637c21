"""Are the lines of reduction gears found, and none where there is none? On a simulated arm, and on the UR10.

    python benchmarks/robustness/gear_lines.py --cases lines --seeds 20 --out lines.json
    python benchmarks/robustness/gear_lines.py --cases none --seeds 40 --out false_lines.json
    python benchmarks/robustness/gear_lines.py --cases held_out --seeds 3 --out held_out.json
    python benchmarks/robustness/gear_lines.py --cases drawn ur10 --seeds 200 --out others.json

`lines` plants four lines of one amplitude: ratio 100 on joint 2 and twice on joint 3, 121 on joint 1 and twice on
joint 4 (0.02 mm noise per coordinate, one marker), and counts those that are found within 1 per rad. `none` scans arms
without lines; `drawn` scans measurements that are drawn from the model itself, many of one arm, so that only the level
of the test is in question. `held_out` calibrates with and without the scan. `ur10` names the lines of two series of
one real robot and the held-out errors.

Fields of a record: `case`, `poses`, `amplitude_urad`, `runs`; `found` the share of planted lines, `false` the share of
runs with any line that was not planted, `rms_without_um` and `rms_with_um` held-out errors (of the truth, simulated).
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

ROOMS = Path(__file__).parents[1]
sys.path[:0] = [str(ROOMS), str(ROOMS / "real_robots")]  # for the modules that benchmarks share

import argparse
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import harness
import torch
from harness import Record
from robot_data import RobotData, data_folder, find, read

import diffeo_calib as dc
from diffeo_calib.calibration import choose_scales
from diffeo_calib.calibration.diagnostics.plausibility import registered
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.scales.leave_one_out import weighed
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.position_errors import find_gear_lines
from diffeo_calib.calibration.scales.selection import defaults, select
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.process.scales import GearLine, Hyperparameters
from diffeo_calib.robots.simulated_arm import SimulatedArm
from diffeo_calib.robots.tree import Tree

PLANTED = ((1, 100.0), (2, 200.0), (0, 121.0), (3, 242.0))
SIZES, AMPLITUDES_URAD = (150, 300, 600), (20, 50, 100)
SAME_FREQUENCY = 1.0
SERIES = {"ur10_d": "measurements_iso_cubes.csv", "ur10_a": "measurements_grid_900.csv"}
CASES = ("lines", "none", "drawn", "held_out", "ur10")
COLUMNS = (
    *("case", "series", "poses", "amplitude_urad", "runs", "found", "false"),
    *("rms_without_um", "rms_with_um", "lines"),
)


def tangent(robot: Tree, data: dc.Measurements) -> tuple[TangentData, Hyperparameters]:
    """The tangent model with scales chosen as in a calibration, before the scan."""
    registration = registered(robot, data)
    identification = identify(registration.geometry, data.q, data.points)
    nominal = GeometryMap(registration.geometry, elastic=True)
    sag = identification.theta.new_zeros(nominal.parameters - nominal.geometry.size)
    theta, sensor = torch.cat([identification.theta, sag]), NoiseModel.of(data, identification.noise)
    model = TangentData(nominal, theta, data.q, data.points.flatten(1), sensor, identification.tails)
    centre = defaults(model, identification.noise, identification.prior)
    first = select(centre, model)
    model = weighed(model, first.scales)
    scales = select(centre, model, start=first.scales).scales
    scales = scales.supported(model.jacobian, model.noise(scales))
    return weighed(model, scales), scales


def right(line: GearLine, planted: tuple[int, float]) -> bool:
    """Whether a line that was found is a planted one."""
    return line.joint == planted[0] and abs(line.frequency - planted[1]) <= SAME_FREQUENCY


def scanned(poses: int, urad: float, seeds: int) -> Record:
    """Shares of lines found, and of runs with others."""
    hits, wrong = torch.zeros(len(PLANTED)), 0
    planted = PLANTED if urad else ()
    for seed in range(seeds):
        arm = SimulatedArm(seed, lines=[(joint, frequency, 1e-6 * urad) for joint, frequency in planted])
        found = find_gear_lines(*tangent(arm.nominal, dc.Measurements(*arm.measure(poses, seed=1000 + seed))))
        hits += torch.tensor([any(right(line, one) for line in found) for one in PLANTED])
        wrong += not all(any(right(line, one) for one in planted) for line in found)
    each = {f"found_joint_{joint + 1}": float(hits[k]) / seeds for k, (joint, _) in enumerate(PLANTED)}
    shares = {"found": float(hits.mean()) / seeds, **each} if planted else {}
    return {"poses": poses, "amplitude_urad": urad, "runs": seeds, **shares, "false": wrong / seeds}


def drawn(poses: int, draws: int) -> Record:
    """Share of scans with a line on measurements that are drawn from the model itself."""
    arm = SimulatedArm(0)
    data, scales = tangent(arm.nominal, dc.Measurements(*arm.measure(poses, seed=1000)))
    total = data.linearisation(scales).gram() + torch.block_diag(*data.weighted_noise(scales))
    factor = torch.linalg.cholesky(total)
    generator, wrong = torch.Generator().manual_seed(0), 0
    for _ in range(draws):
        noise = torch.randn(len(factor), dtype=factor.dtype, generator=generator)
        y = data.y - data.target + (factor @ noise).view_as(data.y)
        wrong += bool(find_gear_lines(replace(data, y=y), scales))
    return {"poses": poses, "runs": draws, "false": wrong / draws}


@contextmanager
def no_scan() -> Iterator[None]:
    """Calibrations without gear lines."""
    scan = choose_scales.position_errors
    before, scan.find_gear_lines = scan.find_gear_lines, lambda *_: ()
    try:
        yield
    finally:
        scan.find_gear_lines = before


def compared(robot: Tree, train: dc.Measurements, error: Callable[[dc.CalibrationResult], float]) -> Record:
    """Held-out errors in um with and without the scan, and the lines by name."""
    result = dc.calibrate(robot, train)
    within = without = error(result)
    if result.gear_lines:  # a scan that finds nothing changes nothing
        with no_scan():
            without = error(dc.calibrate(robot, train))
    lines = "; ".join(line.sentence for line in result.gear_lines)
    return {"rms_without_um": 1e6 * without, "rms_with_um": 1e6 * within, "lines": lines}


def held_out(poses: int, urad: float, seed: int) -> Record:
    """Errors of the true positions of 400 other configurations."""
    arm = SimulatedArm(seed, lines=[(joint, frequency, 1e-6 * urad) for joint, frequency in PLANTED if urad])
    q = arm.sample(400, seed=2000)
    truth = arm.true_points(q)

    def error(result: dc.CalibrationResult) -> float:
        return float((result.model(q) - truth).square().sum(-1).mean().sqrt())

    found = compared(arm.nominal, dc.Measurements(*arm.measure(poses, seed=1000 + seed)), error)
    return {"poses": poses, "amplitude_urad": urad, "runs": 1, "seed": seed} | found


def ur10(series: str, folder: Path | None) -> RobotData:
    """One series of the UR10."""
    place = data_folder(folder)
    return read(place / "ipa_ur10", dict(find(place, ["ipa_ur10"])["ipa_ur10"]) | {"csv": SERIES[series]})


def real(series: str, folder: Path | None) -> Record:
    """Held-out errors and lines of a series of the UR10: 70 % of the rows are fitted."""
    found = ur10(series, folder)
    points = dc.Measurements(found.measurements.q, found.measurements.points)
    train, test = points.split(0.7, seed=0)
    result = compared(found.robot, train, lambda result: dc.evaluate(result.model, test).rms)
    return {"series": series, "poses": len(train), "runs": 1} | result


def measure(arguments: argparse.Namespace) -> Iterator[Record]:
    """Yield the records of the cases asked for."""
    sizes = SIZES[:1] if arguments.quick else arguments.poses
    seeds = 1 if arguments.quick else arguments.seeds
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
        for case in arguments.cases:
            for record in records(case, sizes, seeds, arguments):
                yield {"case": case} | record


def records(case: str, sizes: Sequence[int], seeds: int, arguments: argparse.Namespace) -> Iterator[Record]:
    """The records of one case."""
    if case == "ur10":
        yield from (real(series, arguments.data) for series in SERIES)
        return
    for poses in sizes:
        if case == "drawn":
            yield drawn(poses, seeds)
        elif case == "none":
            yield scanned(poses, 0.0, seeds)
        for urad in arguments.amplitudes if case in ("lines", "held_out") else ():
            if case == "lines":
                yield scanned(poses, urad, seeds)
            else:
                yield from (held_out(poses, urad, seed) for seed in range(seeds))


if __name__ == "__main__":
    harness.run(
        __doc__,
        measure,
        COLUMNS,
        cases=harness.names(CASES, ["lines", "none"]),
        seeds=harness.number(20, "arms, or draws"),
        poses=harness.numbers(SIZES),
        amplitudes={"type": float, "nargs": "+", "default": list(AMPLITUDES_URAD), "metavar": "URAD"},
        data={**harness.DATA, "help": "measured robots"},
    )
