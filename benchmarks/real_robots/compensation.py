"""Where a robot really goes after compensation, with a tool that was never measured, and how long the commands take.

    python benchmarks/real_robots/compensation.py --out compensation.json
    python benchmarks/real_robots/compensation.py --model robot.safetensors --out speed.json

The simulated arm, whose true kinematics are known, is calibrated with measured poses of a frame on its tool, or with
three markers. It shall then bring another tool, 0.25 m from the measured frame and turned, to random poses in the
tracker's frame, from the nominal inverse kinematics of the true base. Methods: `registration` takes the nominal arm
with base and tool as found, `geometry` its geometric calibration, `diffeo_calib` the whole model by `dc.compensate`.

Fields of a record: `measured` (what the calibration saw), `train` poses; `held_out_mm` and `held_out_deg` are the RMS
errors of the method on held-out measurements of the calibrated frame (what `fit` prints); `rms_mm`, `max_mm`, `rms_deg`
are the true errors of the tool at the commands, over `rows` poses that the method reaches; `status` counts rows. With
--model: `rows` per call, `seconds` (median of the repeats), `status`.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

from collections.abc import Callable, Iterator
from dataclasses import replace

import harness
import torch
from baselines import identified
from harness import Record
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.tool import pose_slopes
from diffeo_calib.measurements.poses import angle_between, mark_points, poses_from_marks
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.robots.simulated_arm import SimulatedArm

LEVER = 0.1
TOOL_SHIFT, TOOL_TURN = (0.15, -0.12, 0.16), (0.4, -0.9, 0.3)
"""From the measured frame to the tool: 0.25 m, and a rotation vector of 60 degrees."""
TEST_ROWS, TARGETS = 300, 1000
STEPS = 8
SIZES, QUICK_SIZES = (30, 60, 150), (30,)
COLUMNS = (
    "measured",
    "train",
    "method",
    "held_out_mm",
    "held_out_deg",
    "rms_mm",
    "max_mm",
    "rms_deg",
    "rows",
    "status",
)


class Bench:
    """The arm with a measured frame, its measurements, and targets for another tool.

    Args:
        measured: "poses" of a frame on the tool, or three "markers" that form the frame, as points.
        rows: number of training poses.
    """

    def __init__(self, measured: str, rows: int) -> None:
        self.arm = SimulatedArm(seed=1, markers=3)
        frame = torch.eye(4, dtype=torch.float64)
        frame[:3, 3] = self.arm.truth.tool[0]
        self.arm.truth = replace(self.arm.truth, tool=mark_points(frame[None], LEVER)[0])
        q, points = self.arm.measure(rows + TEST_ROWS, seed=2)
        if measured == "poses":
            data = dc.Measurements.from_poses(q, poses_from_marks(points, LEVER), lever=LEVER)
        else:
            data = dc.Measurements(q, points)
        self.train, self.test = data.rows(slice(0, rows)), data.rows(slice(rows, None))
        self.start = self.arm.sample(TARGETS, seed=9)
        nominal = self.arm.nominal(self.start) @ self.tool(self.arm.truth.tool)
        self.targets = self.arm.truth.base @ nominal

    @staticmethod
    def tool(markers: Tensor) -> Tensor:
        """(4, 4) the tool, from the three points of the measured frame (3, 3) in the frame of the tip."""
        turn = rotation(torch.tensor(TOOL_TURN, dtype=torch.float64))
        beside = transforms(turn, torch.tensor(TOOL_SHIFT, dtype=torch.float64))
        return poses_from_marks(markers[None], LEVER)[0] @ beside

    def true_errors(self, q: Tensor, rows: Tensor) -> Record:
        """Errors of the true arm at commands (N, 6), over some rows."""
        tool = mark_points(self.tool(self.arm.truth.tool)[None], LEVER)[0]
        points = replace(self.arm.truth, tool=tool)
        before, self.arm.truth = self.arm.truth, points
        poses, targets = poses_from_marks(self.arm.true_points(q[rows]), LEVER), self.targets[rows]
        self.arm.truth = before
        distances = (poses - targets)[:, :3, 3].norm(dim=1)
        angles = angle_between(poses[:, :3, :3], targets[:, :3, :3]).rad2deg()
        rms = {"rms_mm": 1e3 * distances, "rms_deg": angles}
        record: Record = {name: float(values.square().mean().sqrt()) for name, values in rms.items()}
        return record | {"max_mm": 1e3 * float(distances.max()), "rows": len(rows.nonzero())}

    def held_out(self, kinematics: Callable[[Tensor], Tensor]) -> Record:
        """Errors on measurements that were not fitted."""
        found = dc.evaluate(kinematics, self.test)
        return {"held_out_mm": 1e3 * found.rms, "held_out_deg": found.orientation.rms}


def geometric_commands(geometry: Geometry, tool: Tensor, targets: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse kinematics of a geometry by Newton's method: commands (N, n), and which rows reach their targets."""
    placed, q = replace(geometry, tool=mark_points(tool[None], LEVER)[0]), start
    for _ in range(STEPS):
        points = placed.points(q)
        poses = poses_from_marks(points, LEVER)
        spin = targets[:, :3, :3] @ poses[:, :3, :3].mT
        turn = 0.5 * torch.stack([spin[:, i, j] - spin[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], 1)
        error = torch.cat([(targets - poses)[:, :3, 3], turn], 1)
        slopes = pose_slopes(points, placed.jacobian(q))
        q = q + torch.linalg.lstsq(slopes, error[..., None]).solution[..., 0].clamp(-0.1, 0.1)
    away = (poses_from_marks(placed.points(q), LEVER) - targets)[:, :3, 3].norm(dim=1)
    return q, (away < 1e-9) & ((q - start).abs().amax(1) < 0.02)


def truth(quick: bool) -> Iterator[Record]:
    """Yield a record for every calibration and method, over the rows that all methods reach."""
    for measured in ("poses", "markers"):
        for rows in QUICK_SIZES if quick else SIZES:
            bench = Bench(measured, rows)
            yield from compared(bench, measured)


def compared(bench: Bench, measured: str) -> Iterator[Record]:
    """Yield the records of one calibration."""
    robot, train = bench.arm.nominal, bench.train
    model = dc.calibrate(robot, train).model
    geometries = {"registration": register(robot, train.q, train.points).geometry, "geometry": identified(robot, train)}
    commands, good = {}, torch.ones(TARGETS, dtype=torch.bool)
    for method, geometry in geometries.items():
        commands[method], there = geometric_commands(geometry, bench.tool(geometry.tool), bench.targets, bench.start)
        good &= there
    own = bench.tool(model.geometry.tool)
    found = dc.compensate(model, bench.targets, bench.start, tool=own, frame="measuring")
    commands["diffeo_calib"], good = found.q, good & found.reached
    kinematics = {name: geometry.points for name, geometry in geometries.items()} | {"diffeo_calib": model}
    for method, q in commands.items():
        record: Record = {"measured": measured, "train": len(train), "method": method}
        record |= bench.held_out(kinematics[method]) | bench.true_errors(q, good)
        yield record | {"status": _words(found) if method == "diffeo_calib" else None}


def speed(path: Path, quick: bool) -> Iterator[Record]:
    """Yield the times of commands for a saved model, near the configurations that it was fitted to."""
    model = dc.load(path)
    if not isinstance(model, dc.CalibratedKinematics):
        raise InputError.of(f"'{path}' is not a robot's model", fix="pass a file written by `diffeo-calib fit`")
    generator = torch.Generator().manual_seed(0)
    for rows in (1, 100) if quick else (1, 100, 10_000):
        pick = torch.randint(len(model.configurations), (rows,), generator=generator)
        noise = 0.04 * torch.rand(rows, model.robot.n, generator=generator, dtype=torch.float64)
        start = model.configurations[pick] + noise - 0.02
        poses = model.robot(start)
        for kind, targets in (("poses", poses), ("positions", poses[:, :3, 3])):
            call = _call(model, targets, start)
            times = sorted(harness.interleaved({kind: call}, 20 if rows == 1 else 3)[kind])
            yield {"targets": kind, "rows": rows, "seconds": times[len(times) // 2], "status": _words(call())}


def _call(model: dc.CalibratedKinematics, targets: Tensor, start: Tensor) -> Callable[[], dc.Compensation]:
    return lambda: dc.compensate(model, targets, start)


def _words(found: dc.Compensation) -> str:
    return ", ".join(f"{count} {name}" for name, count in found.counts.items())


def main() -> None:
    """Read the arguments, measure and report."""
    parser = harness.parser(__doc__)
    parser.add_argument("--model", type=Path, metavar="MODEL", help="measure the speed of this model instead")
    plan = parser.parse_args()
    records = truth(plan.quick) if plan.model is None else speed(plan.model, plan.quick)

    def program() -> None:
        harness.report(records, plan.out, COLUMNS if plan.model is None else ())

    harness.guarded(program)


if __name__ == "__main__":
    main()
