"""Times of the package's calls on an idle machine and beside a process that keeps one core busy.

    python benchmarks/robustness/busy_machine.py --out busy.json

Every call runs alternately without and with one busy process, which this program starts and stops; the first run, which
fills caches, does not count. torch has its default number of threads: the package limits them itself, see
diffeo_calib/common/threads.py. Run it on a machine that is idle otherwise.

Fields of a record: `call` says what runs; `threads` is torch's number of them; `idle_ms` and `busy_ms` are medians,
`idle_worst_ms` and `busy_worst_ms` the largest times; `ratio` is busy by idle.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / room) for room in ("kernel_sums", "paper_arm", "")]  # shared modules

import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from statistics import median

import harness
import torch
from harness import Record
from landmarks import landmarks
from ours import Ours
from section_5 import section_5

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm

REPEATS, QUICK_REPEATS = 7, 2
SETTLING_S = 0.3
"""Time in which a busy process gets its core."""


TRAINING = 150
"""Poses of the model that is queried."""
Run = Callable[[], object]


def rr_fit() -> Callable[[], object]:
    """The fit of the paper's RR arm."""
    problem = section_5(0.01)
    return lambda: dc.fit(problem, integrator=dc.RK4(2))


def kernel_sum(count: int) -> Run:
    """One sum of the Gaussian kernel between ``count`` points and themselves."""
    return Ours(landmarks(count, 3)).sum


def loss_and_gradient(count: int) -> Run:
    """Loss of a flow of ``count`` landmarks, and its gradient."""
    method = Ours(landmarks(count, 3))
    return lambda: method.loss_and_gradient(1)


def calibration(poses: int) -> Run:
    """The calibration of a simulated arm."""
    robot, data, _ = _measured(poses)
    return lambda: dc.calibrate(robot, data)


def positions(rows: int) -> Run:
    """Positions of the marker."""
    model, q = _model(rows)
    return lambda: model(q)


def predictions(rows: int) -> Run:
    """Positions of the marker with their covariances."""
    model, q = _model(rows)
    return lambda: model.predict(q)


def commands(rows: int) -> Run:
    """Joint values that bring the tool to given positions."""
    model, q = _model(rows)
    targets = model.tool_poses(q)[:, :3, 3]
    return lambda: dc.compensate(model, targets, start=q)


def command_line(poses: int) -> Run:
    """A whole command that measures and calibrates a simulated arm, in a process of its own."""
    folder = tempfile.mkdtemp(prefix="diffeo_calib_")
    words = [sys.executable, "-m", "diffeo_calib", "demo", "--count", str(poses), "--output", folder]
    return lambda: subprocess.run(words, check=True, capture_output=True)


CALLS: dict[str, Callable[[], Run]] = {
    "fit of the RR arm, RK4(2)": rr_fit,
    **{f"kernel sum, {n} points": partial(kernel_sum, n) for n in (1024, 4096, 16384)},
    **{f"loss and gradient, {n} points": partial(loss_and_gradient, n) for n in (256, 1024, 4096)},
    **{f"calibration, {n} poses": partial(calibration, n) for n in (60, 450)},
    **{f"positions, {n} rows": partial(positions, n) for n in (1, 10_000)},
    "predictions, 1000 rows": partial(predictions, 1000),
    "commands, 1000 rows": partial(commands, 1000),
    "command line, 60 poses": partial(command_line, 60),
}
QUICK_CALLS = ("fit of the RR arm, RK4(2)", "kernel sum, 1024 points")


def measure(quick: bool) -> Iterator[Record]:
    """Yield a record for every call."""
    for name in QUICK_CALLS if quick else CALLS:
        yield {
            "call": name,
            "threads": torch.get_num_threads(),
            **compare(CALLS[name](), QUICK_REPEATS if quick else REPEATS),
        }


def compare(call: Run, repeats: int) -> Record:
    """Times without and with a busy process, in turn."""
    call()
    idle, busy = [], []
    for _ in range(repeats):
        idle.append(milliseconds(call))
        with busy_process():
            busy.append(milliseconds(call))
    middle = median(idle), median(busy)
    return {
        "idle_ms": middle[0],
        "idle_worst_ms": max(idle),
        "busy_ms": middle[1],
        "busy_worst_ms": max(busy),
        "ratio": middle[1] / middle[0],
    }


def milliseconds(call: Run) -> float:
    """The time of one call; of the fastest of a few if it takes less than 10 ms."""
    times, end = [], time.perf_counter() + 0.03
    while not times or (time.perf_counter() < end and times[0] < 10.0):
        begin = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - begin))
    return median(times)


@contextmanager
def busy_process() -> Iterator[None]:
    """A process that keeps one core busy."""
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as process:
        try:
            time.sleep(SETTLING_S)
            yield
        finally:
            process.kill()


def _measured(poses: int) -> tuple[dc.Chain, dc.Measurements, torch.Tensor]:
    """A robot, measurements of ``poses`` configurations, and others (10,000, n) that are not measured."""
    arm = SimulatedArm(seed=1)
    q, points = arm.measure(poses, seed=2)
    return arm.nominal, dc.Measurements(q, points), arm.measure(10_000, seed=3)[0]


def _model(rows: int) -> tuple[dc.CalibratedKinematics, torch.Tensor]:
    """A calibrated model and configurations (rows, n)."""
    robot, data, q = _measured(TRAINING)
    return dc.calibrate(robot, data).model, q[:rows]


if __name__ == "__main__":
    harness.run(__doc__, lambda plan: measure(plan.quick))
