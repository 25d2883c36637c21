"""A calibrated robot in C: size and time of the generated file, and queries against NumPy and nominal kinematics.

    python benchmarks/real_robots/generated_c.py --data FOLDER --out generated_c.json
    python benchmarks/real_robots/generated_c.py --models model.safetensors

Without --models, 70 % of a data set are calibrated. The file is compiled by gcc or cc with -std=c99 -O2. Configurations
are random within the range of the measured ones. A C program runs the queries, one configuration after another, on one
thread; in Python the same configurations are asked one by one. Pinocchio computes the nominal robot's tool pose and
Jacobian, called from Python; it is left out if it is not installed, and for robots with mimic joints.

Fields of a record: `controls` of the model; `query`; `c_us`, `numpy_us` and `pinocchio_us` are microseconds per
configuration, the least of several runs: other programs can only slow a run down; `write_s` and `compile_s` are the
seconds to write and to compile the file, `source_mb` and `object_mb` its sizes before and after.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import shutil
import subprocess
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from importlib import import_module
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import harness
import numpy as np
import torch
from harness import Record
from queries import configurations, models

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop import CFiles, write_c
from diffeo_calib.interop.c_source import array
from diffeo_calib.kinematics.tool import program_of

ROWS, RUNS, QUICK_RUNS = 20, 500, 3
FLAGS = ("-std=c99", "-O2")
COLUMNS = ("controls", "query", "c_us", "numpy_us", "pinocchio_us", "write_s", "compile_s", "source_mb", "object_mb")

T = TypeVar("T")
Array = np.ndarray
Query = Callable[[Array], object]
CALLS = {
    "markers": "robot_markers(q[i], p, NULL)",
    "markers and Jacobian": "robot_markers(q[i], p, jacobian)",
    "tool pose": "robot_tool_pose(q[i], pose, NULL)",
    "tool pose and Jacobian": "robot_tool_pose(q[i], pose, jacobian)",
    "Newton step": "robot_newton_step(q[i], target, 0.1, 0.02, next)",
}
TIMER = """
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include "robot.h"
static const double q[%(rows)d][%(n)d] = %(q)s;
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec;
}
int main(void)
{
    double p[%(p)d], pose[16], target[16], jacobian[%(jacobian)d], next[%(n)d];
    int run, i;
    robot_tool_pose(q[0], target, NULL);
%(loops)s
    return 0;
}
"""
LOOP = """
    {{
        double least = 1e30;
        for (run = 0; run < {runs}; ++run) {{
            const double begin = now();
            for (i = 0; i < {rows}; ++i) {call};
            if (now() - begin < least) least = now() - begin;
        }}
        printf("%.6f\\n", least / {rows});
    }}"""


def measure(plan: Namespace) -> Iterator[Record]:
    """Yield a record for every model and query."""
    torch.set_num_threads(1)
    for model in models(plan):
        with TemporaryDirectory() as folder:
            yield from records(model, Path(folder), QUICK_RUNS if plan.quick else RUNS)


def records(model: dc.CalibratedKinematics, folder: Path, runs: int) -> Iterator[Record]:
    """Write and compile a model, and time all queries to it."""
    files, seconds = timed(lambda: write_c(model, folder / "robot.c", frame="measuring"))
    compiled = files.source.with_suffix(".o")
    file: Record = {"write_s": seconds, "compile_s": timed(lambda: built(["-c", files.source, "-o", compiled]))[1]}
    file |= {"source_mb": len(files.texts[0]) / 1e6, "object_mb": compiled.stat().st_size / 1e6}
    q, tool = configurations(model, ROWS).numpy(), model.tool.numpy()
    in_c = c_times(files, q, model.markers, runs)
    in_python, nominal = numpy_queries(model, tool), pinocchio_queries(model.robot, tool)
    for query in CALLS:
        yield {
            "controls": len(model.configurations),
            "query": query,
            "c_us": in_c[query],
            "numpy_us": least_time(in_python[query], q[:, None], runs) if query in in_python else None,
            "pinocchio_us": least_time(nominal[query], q, runs) if query in nominal else None,
            **file,
        }


def numpy_queries(model: dc.CalibratedKinematics, tool: Array) -> dict[str, Query]:
    """Queries to the program of the model."""
    program = program_of(model.map.deformation)
    if program is None:
        raise InputError.of("this model has no program", fix="pass one with constant time steps")
    return {
        "markers": program.points,
        "markers and Jacobian": program.points_and_jacobian,
        "tool pose": lambda q: program.poses(q, tool, "measuring"),
        "tool pose and Jacobian": lambda q: program.poses_and_jacobian(q, tool, "measuring"),
    }


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """The result and the seconds of a call."""
    begin = time.perf_counter()
    return call(), time.perf_counter() - begin


def built(words: list[str | Path]) -> None:
    """Compile."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise InputError.of("no C compiler was found", expected="gcc or cc", fix="install one")
    subprocess.run([compiler, *FLAGS, *map(str, words)], check=True, capture_output=True)


def c_times(files: CFiles, q: Array, markers: int, runs: int) -> dict[str, float]:
    """Microseconds per configuration of every query in C."""
    loops = "".join(LOOP.format(runs=runs, rows=len(q), call=call) for call in CALLS.values())
    n = q.shape[1]
    sizes = {"rows": len(q), "n": n, "p": 3 * markers, "jacobian": max(3 * markers, 6) * n}
    main, program = files.source.with_name("main.c"), files.source.with_name("main")
    main.write_text(TIMER % {**sizes, "q": array(q), "loops": loops})
    built([main, files.source, "-o", program, "-lm"])
    done = subprocess.run([program], check=True, capture_output=True, text=True)
    return dict(zip(CALLS, map(float, done.stdout.split()), strict=True))


def least_time(query: Query, rows: Array, runs: int) -> float:
    """Microseconds per configuration in Python."""
    least = np.inf
    for _ in range(max(runs // 10, 1)):
        begin = time.perf_counter()
        for row in rows:
            query(row)
        least = min(least, time.perf_counter() - begin)
    return 1e6 * float(least) / len(rows)


def pinocchio_queries(robot: dc.Chain, tool: Array) -> dict[str, Query]:
    """Queries to the nominal robot; none without pinocchio, or with mimic joints."""
    try:
        pin: Any = import_module("pinocchio")
    except ImportError:
        return {}
    if any(joint.mimic is not None for joint in robot.joints):
        return {}
    model, parent, placement = pin.Model(), 0, np.eye(4)
    for joint in robot.joints:
        placement = placement @ joint.origin.numpy()
        if joint.kind == "fixed":
            continue
        kind = pin.JointModelPrismaticUnaligned if joint.kind == "prismatic" else pin.JointModelRevoluteUnaligned
        parent = model.addJoint(parent, kind(joint.axis.numpy()), pin.SE3(placement), joint.name)
        placement = np.eye(4)
    frame = model.addFrame(pin.Frame("tool", parent, 0, pin.SE3(placement @ tool), pin.FrameType.OP_FRAME))
    data = model.createData()

    def pose(q: Array) -> object:
        pin.forwardKinematics(model, data, q)
        return pin.updateFramePlacement(model, data, frame)

    def jacobian(q: Array) -> object:
        slopes = pin.computeFrameJacobian(model, data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        return slopes, pin.updateFramePlacement(model, data, frame)

    return {"tool pose": pose, "tool pose and Jacobian": jacobian}


def arguments(given: list[str] | None = None) -> Namespace:
    """Parse the command line."""
    parser = harness.parser(__doc__)
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="folder of data sets; default: $DIFFEO_CALIB_DATA")
    parser.add_argument("--dataset", default="ipa_ur10", metavar="NAME")
    parser.add_argument("--models", nargs="+", type=Path, default=[], metavar="FILE", help="do not calibrate")
    return parser.parse_args(given)


def run(plan: Namespace) -> None:
    """Measure and report."""
    harness.report(measure(plan), plan.out, COLUMNS)


if __name__ == "__main__":
    harness.guarded(lambda: run(arguments()))
