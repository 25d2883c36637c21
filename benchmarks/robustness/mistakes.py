"""Realistic mistakes in measurements: what `calibrate` says about them, beside the true error of the model.

    python benchmarks/robustness/mistakes.py --arms 5 --out mistakes.json
    python benchmarks/robustness/mistakes.py --clean 200 --out clean.json

`true_mm` is the RMS error at 300 random configurations after the best rigid motion, `expected_mm` what the model
expects of itself over the joint ranges of its rows, `said` the refusal or the first words of the warnings and how many
rows look wrong, `silent` whether the true error is above three times the expected one and nothing was said. Clean
campaigns differ in robot, rows, markers and noise: plain, with outliers, with heavy tails, and in blocks along motions;
there every warning counts as a false alarm.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import argparse
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import harness
import numpy as np
import torch
from functionals import FIXED, FOCAL, HEIGHTS, NORMALS, cameras
from harness import Record
from held_out import rms_mm
from simulated_sockets import SPACING, rest_in_sockets
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.se3 import rotation, transforms

ROWS, PLACES = 120, 6
COLUMNS = ("mistake", "arm", "true_mm", "expected_mm", "silent", "said")
HALF = ROWS // 2 + 2
TRUTH_ROWS = 300


class Campaign(NamedTuple):
    """Rows of an arm, and the robot that a user believes it to be."""

    robot: Any
    data: Any


Mistake = Callable[[SimulatedArm, np.random.Generator], Campaign]
MISTAKES: dict[str, Mistake] = {}


def mistake(name: str, *arguments: Any) -> Callable[[Callable[..., Campaign]], Callable[..., Campaign]]:
    """Register a mistake under a name, with these arguments."""

    def named(function: Callable[..., Campaign]) -> Callable[..., Campaign]:
        MISTAKES[name] = lambda arm, rng: function(arm, rng, *arguments)
        return function

    return named


def noise(rng: np.random.Generator, like: Tensor, deviation: float = 2e-5) -> Tensor:
    """Normal errors, m."""
    return deviation * torch.from_numpy(rng.standard_normal(tuple(like.shape)))


def tracked(arm: SimulatedArm, rng: np.random.Generator, true_q: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Configurations as the table has them, and the tracker's positions of these or of others that the arm took."""
    q = arm.sample(ROWS, int(rng.integers(1 << 30)))
    y = arm.true_points(q if true_q is None else q + true_q)
    return q, y + noise(rng, y)


def of_tracker(arm: SimulatedArm, q: Tensor, y: Tensor) -> Campaign:
    """Positions of the tracker."""
    return Campaign(arm.nominal, dc.Measurements(q, y, doubt=False))


def ramp() -> Tensor:
    """(N, 1, 1) from 0 in the first row to 1 in the last."""
    return torch.linspace(0, 1, ROWS, dtype=torch.float64)[:, None, None]


# --- positions that are not those of this robot ---


@mistake("nominal positions", 0.0)
@mistake("nominal positions to 0.001 mm", 1e-6)
@mistake("nominal positions to 0.01 mm", 1e-5)
@mistake("nominal positions to 0.1 mm", 1e-4)
def _nominal(arm: SimulatedArm, rng: np.random.Generator, step: float) -> Campaign:
    q, _ = tracked(arm, rng)
    T = arm.nominal(q)
    y = T[:, None, :3, 3] + T[:, None, :3, :3] @ torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    return of_tracker(arm, q, (y / step).round() * step if step else y)


@mistake("nominal poses to 0.1 mm")
def _nominal_poses(arm: SimulatedArm, rng: np.random.Generator) -> Campaign:
    q, _ = tracked(arm, rng)
    T = arm.nominal(q)
    T[:, :3, 3] = (T[:, :3, 3] / 1e-4).round() * 1e-4
    return Campaign(arm.nominal, dc.Measurements.from_poses(q, T, doubt=False))


@mistake("link before elbow_joint 3 mm longer", "elbow_joint", 3e-3)
@mistake("link before elbow_joint 10 mm longer", "elbow_joint", 1e-2)
@mistake("link before wrist_bend_joint 3 mm longer", "wrist_bend_joint", 3e-3)
@mistake("another variant: links 20 mm longer", "elbow_joint wrist_bend_joint", 2e-2)
def _variant(arm: SimulatedArm, rng: np.random.Generator, joints: str, longer: float) -> Campaign:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        arm.write_urdf(path)
        text = path.read_text()
        for joint in joints.split():
            found = re.search(rf'<joint name="{joint}".*?<origin xyz="([^"]*)"', text, re.S)
            if found is None:
                raise AssertionError(joint)
            xyz = np.array([float(word) for word in found[1].split()])
            xyz *= 1 + longer / np.linalg.norm(xyz)
            text = text[: found.start(1)] + " ".join(map(repr, xyz.tolist())) + text[found.end(1) :]
        path.write_text(text)
        robot = dc.load_urdf(path, "base_link", "flange")
    return of_tracker(arm, *tracked(arm, rng))._replace(robot=robot)


@mistake("joints 4 and 6 exchanged", "exchange")
@mistake("joint 3 with the other sign", "sign")
@mistake("joint 5 in degrees", "degrees")
@mistake("rows of joints one late", "late")
@mistake("joints to 0.1 degrees", "round")
def _joints(arm: SimulatedArm, rng: np.random.Generator, how: str) -> Campaign:
    q, y = tracked(arm, rng)
    if how == "exchange":
        q = q[:, [0, 1, 2, 5, 4, 3]]
    elif how == "sign":
        q[:, 2] *= -1
    elif how == "degrees":
        q[:, 4] = q[:, 4].rad2deg()
    elif how == "late":
        q = q.roll(1, 0)
    else:
        q = (q.rad2deg() * 10).round().div(10).deg2rad()
    return of_tracker(arm, q, y)


@mistake("mirrored frame")
def _mirrored(arm: SimulatedArm, rng: np.random.Generator) -> Campaign:
    q, y = tracked(arm, rng)
    return of_tracker(arm, q, y * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))


# --- lengths ---


@mistake("tracker x 1.001", (1.001,) * 3)
@mistake("tracker x 1.003", (1.003,) * 3)
@mistake("tracker x 1.005", (1.005,) * 3)
@mistake("tracker x 1.01", (1.01,) * 3)
@mistake("tracker x 1.2", (1.2,) * 3)
@mistake("one axis x 1.001", (1.0, 1.001, 1.0))
def _scale(arm: SimulatedArm, rng: np.random.Generator, factors: tuple[float, float, float]) -> Campaign:
    q, y = tracked(arm, rng)
    return of_tracker(arm, q, y * torch.tensor(factors, dtype=torch.float64))


# --- changes within the campaign ---


@mistake("joint 2 jumps by 0.2 mrad", 1, 2e-4)
@mistake("joint 2 jumps by 0.5 mrad", 1, 5e-4)
@mistake("joint 2 jumps by 2 mrad", 1, 2e-3)
@mistake("joint 4 jumps by 1 mrad", 3, 1e-3)
@mistake("joint 3 jumps by 20 mrad", 2, 2e-2)
@mistake("joint 1 jumps by 1 mrad", 0, 1e-3)
@mistake("joint 6 jumps by 1 mrad", 5, 1e-3)
def _jump(arm: SimulatedArm, rng: np.random.Generator, joint: int, size: float) -> Campaign:
    moved = torch.zeros(ROWS, 6, dtype=torch.float64)
    moved[HALF:, joint] = size
    return of_tracker(arm, *tracked(arm, rng, moved))


@mistake("joint 2 drifts by 1 mrad", 1e-3)
def _joint_drift(arm: SimulatedArm, rng: np.random.Generator, size: float) -> Campaign:
    moved = torch.zeros(ROWS, 6, dtype=torch.float64)
    moved[:, 1] = size * ramp()[:, 0, 0]
    return of_tracker(arm, *tracked(arm, rng, moved))


@mistake("device moves by 0.5 mm", 5e-4, 0.0)
@mistake("device moves by 0.2 mm", 2e-4, 0.0)
@mistake("device turns by 0.1 mrad", 0.0, 1e-4)
def _device(arm: SimulatedArm, rng: np.random.Generator, shift: float, turn: float) -> Campaign:
    q, y = tracked(arm, rng)
    R = rotation(turn * torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64))
    y[HALF:] = y[HALF:] @ R.mT + shift * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    return of_tracker(arm, q, y)


@mistake("marker slips by 0.3 mm", 3e-4)
def _marker(arm: SimulatedArm, rng: np.random.Generator, size: float) -> Campaign:
    q, y = tracked(arm, rng)
    y[HALF:, 0] += arm.truth.poses(q)[HALF:, :3, :3] @ torch.tensor([0.0, size, 0.0], dtype=torch.float64)
    return of_tracker(arm, q, y)


@mistake("device drifts by 0.3 mm", 3e-4, 0.0)
@mistake("device drifts by 1 mm", 1e-3, 0.0)
@mistake("arm grows by 100 ppm", 0.0, 1e-4)
@mistake("arm grows by 500 ppm", 0.0, 5e-4)
def _drift(arm: SimulatedArm, rng: np.random.Generator, shift: float, growth: float) -> Campaign:
    q, y = tracked(arm, rng)
    base = arm.truth.base[:3, 3]
    y = base + (y - base) * (1 + growth * ramp()) + shift * ramp() * torch.tensor([0.8, 0.6, 0.0])
    return of_tracker(arm, q, y)


# --- rows that are wrong one by one ---


@mistake("backlash of 0.2 mrad", 2e-4)
@mistake("backlash of 1 mrad", 1e-3)
def _backlash(arm: SimulatedArm, rng: np.random.Generator, size: float) -> Campaign:
    signs = torch.from_numpy(rng.choice([-0.5, 0.5], (ROWS, 6)))
    return of_tracker(arm, *tracked(arm, rng, size * signs))


@mistake("30 % of the rows wrong by 0.3 mm")
def _many_wrong(arm: SimulatedArm, rng: np.random.Generator) -> Campaign:
    q, y = tracked(arm, rng)
    rows = torch.from_numpy(rng.choice(ROWS, ROWS * 3 // 10, replace=False))
    return of_tracker(arm, q, y.index_add(0, rows, noise(rng, y[rows], 3e-4 / 3**0.5)))


@mistake("tracker repeats its last value in 10 % of the rows")
def _repeats(arm: SimulatedArm, rng: np.random.Generator) -> Campaign:
    q, y = tracked(arm, rng)
    for row in sorted(rng.choice(np.arange(1, ROWS), ROWS // 10, replace=False).tolist()):
        y[row] = y[row - 1]
    return of_tracker(arm, q, y)


# --- payloads and sessions ---


@mistake("payload in g in half of the rows", "grams")
@mistake("payloads shuffled", "shuffled")
@mistake("payloads one row late", "late")
@mistake("20 rows labelled 0 that carried 10 kg", "empty")
@mistake("10 kg written as 1", "digit")
def _payloads(arm: SimulatedArm, rng: np.random.Generator, how: str) -> Campaign:
    masses = torch.from_numpy(rng.choice((0.0, 5.0, 10.0), ROWS))
    q, said = arm.sample(ROWS, int(rng.integers(1 << 30))), masses.clone()
    if how == "grams":
        said[HALF:] *= 1e3
    elif how == "shuffled":
        said = said[torch.from_numpy(rng.permutation(ROWS))]
    elif how == "late":
        said = said.roll(1)
    elif how == "empty":
        said[(masses == 10).nonzero()[:20, 0]] = 0.0
    else:
        said[masses == 10] = 1.0
    y = arm.true_points(q, masses)
    return Campaign(arm.nominal, dc.Measurements(q, y + noise(rng, y), doubt=False).with_payload(said))


@mistake("border of sessions three rows late")
def _border(arm: SimulatedArm, rng: np.random.Generator) -> Campaign:
    q, y = tracked(arm, rng)
    T = rotation(torch.tensor([0.0, 0.02, 0.01], dtype=torch.float64))
    y[HALF - 3 :] = y[HALF - 3 :] @ T.mT + 0.005
    names = ["a" if row < HALF else "b" for row in range(ROWS)]
    return Campaign(arm.nominal, dc.Measurements(q, y, doubt=False).with_sessions(names))


# --- without a tracker ---


def ball(arm: SimulatedArm, q: Tensor) -> Tensor:
    """True places of the ball in the robot's base, m."""
    return (arm.true_points(q)[:, 0] - arm.truth.base[:3, 3]) @ arm.truth.base[:3, :3]


@mistake("wire x 1.01", 1.01, 0.0, 0.0)
@mistake("wire's zero set anew, 5 mm", 1.0, 5e-3, 0.0)
@mistake("wire's zero set anew, 0.5 mm", 1.0, 5e-4, 0.0)
@mistake("wire, joint 2 jumps by 1 mrad", 1.0, 0.0, 1e-3)
def _wire(arm: SimulatedArm, rng: np.random.Generator, scale: float, zero: float, jump: float) -> Campaign:
    q, which = arm.sample(ROWS, int(rng.integers(1 << 30))), torch.arange(ROWS) % 3
    moved = q.clone()
    moved[HALF:, 1] += jump
    lengths = (ball(arm, moved) - FIXED[which]).norm(dim=1)
    lengths = scale * lengths + zero * (torch.arange(ROWS) >= HALF) + noise(rng, lengths)
    names = [f"anchor {number}" for number in which.tolist()]
    return Campaign(arm.nominal, dc.Readings.distances(q, lengths, names, offset_std=0.1))


@mistake("height gauge x 1.01", 1.01)
def _gauge(arm: SimulatedArm, rng: np.random.Generator, scale: float) -> Campaign:
    q, which = arm.sample(ROWS, int(rng.integers(1 << 30))), torch.arange(ROWS) % 3
    heights = (ball(arm, q) * NORMALS[which]).sum(1) - HEIGHTS[which, 0]
    names = [f"plane {number}" for number in which.tolist()]
    return Campaign(arm.nominal, dc.Readings.heights(q, scale * heights + noise(rng, heights), names))


@mistake("camera: focal length 5 % too long", 1.05, 0.0)
@mistake("camera: principal point of another image", 1.0, 320.0)
def _camera(arm: SimulatedArm, rng: np.random.Generator, focal: float, shift: float) -> Campaign:
    q, which = arm.sample(ROWS, int(rng.integers(1 << 30))), torch.arange(ROWS) % 2
    views = cameras()[which, :12].unflatten(1, (3, 4))
    seen = torch.einsum("nij,nj->ni", views, torch.nn.functional.pad(ball(arm, q), (0, 1), value=1.0))
    pixels = FOCAL[0] * seen[:, :2] / seen[:, 2:] + 1000.0
    pixels = pixels + noise(rng, pixels, 0.05)
    names = [f"camera {number}" for number in which.tolist()]
    told = focal * FOCAL[0]
    return Campaign(
        arm.nominal, dc.Readings.images(q, pixels, names, focal=(told, told), centre=(1000.0 + shift, 1000.0 + shift))
    )


def resting(arm: SimulatedArm, rng: np.random.Generator, length: float, rows: int = 20) -> tuple[Tensor, Any]:
    """Rows in sockets that a user believes to be ``length`` apart."""
    found = rest_in_sockets(arm, int(rng.integers(1 << 30)), places=PLACES, rows=rows)
    sockets = dc.Measurements.from_sockets(
        found.q, found.names, distances={("0", "1"): length}, distance_std=3e-5, doubt=False
    )
    return found.q, sockets


@mistake("sockets 50.8 mm for 50", 0.0508)
@mistake("sockets 55 mm for 50", 0.055)
def _sockets(arm: SimulatedArm, rng: np.random.Generator, length: float) -> Campaign:
    return Campaign(arm.nominal, resting(arm, rng, length)[1])


@mistake("sockets, joint 2 changes by 1 mrad", 1e-3)
@mistake("sockets, joint 2 changes by 10 mrad", 1e-2)
def _socket_jump(arm: SimulatedArm, rng: np.random.Generator, size: float) -> Campaign:
    found = rest_in_sockets(arm, int(rng.integers(1 << 30)), places=PLACES, rows=20)
    found.q[len(found.q) // 2 :, 1] -= size  # the encoder shows less than before
    distances = {("0", "1"): SPACING}
    data = dc.Measurements.from_sockets(found.q, found.names, distances=distances, distance_std=3e-5, doubt=False)
    return Campaign(arm.nominal, data)


@mistake("mixture: tracker x 1.005", 1.005)
def _mixture(arm: SimulatedArm, rng: np.random.Generator, scale: float) -> Campaign:
    _, sockets = resting(arm, rng, SPACING, rows=10)
    q, y = tracked(arm, rng)
    return Campaign(arm.nominal, dc.Observations.joined([dc.Measurements(q, scale * y, doubt=False), sockets]))


# --- poses ---


def posed(arm: SimulatedArm, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Configurations and measured poses (N, 4, 4) of the flange."""
    q, y = tracked(arm, rng)
    R = rotation(noise(rng, y[:, 0], 5e-5)) @ arm.truth.poses(q)[:, :3, :3]  # its origin is the marker
    return q, transforms(R, y[:, 0])


@mistake("poses x 1.01", "scale")
@mistake("poses inverted", "inverted")
@mistake("poses with transposed rotations", "transposed")
@mistake("poses: device turns by 0.1 mrad", "turns")
def _poses(arm: SimulatedArm, rng: np.random.Generator, how: str) -> Campaign:
    q, T = posed(arm, rng)
    if how == "scale":
        T[:, :3, 3] *= 1.01
    elif how == "inverted":
        T = torch.linalg.inv(T)
    elif how == "transposed":
        T[:, :3, :3] = T[:, :3, :3].mT.clone()
    else:
        step = transforms(rotation(torch.tensor([0.0, 6e-5, 8e-5], dtype=torch.float64)), T[0, :3, 3] * 0)
        T[HALF:] = step @ T[HALF:]
    return Campaign(arm.nominal, dc.Measurements.from_poses(q, T, doubt=False))


# --- judging ---


def calibrated(campaign: Campaign) -> tuple[Any, list[str]]:
    """The result of a calibration, None if it was refused, and what was said."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = dc.calibrate(campaign.robot, campaign.data)
        except dc.DiffeoCalibError as error:
            return None, [f"refused: {error}"]
    return result, [str(one.message) for one in caught]


def judged(arm: SimulatedArm, campaign: Campaign) -> Record:
    """Errors of the model and what was said."""
    result, said = calibrated(campaign)
    words = "; ".join(text.partition(": expected")[0][:120] for text in said)
    if result is None:
        return {"silent": False, "said": words}
    q = arm.sample(TRUTH_ROWS, 999)
    truth, points = arm.true_points(q)[:, -1], result.model(q).detach()[:, -1]  # the last marker is the ball
    if getattr(campaign.data, "lever", None) is not None:
        points = result.model.poses(q).detach()[:, :3, 3]
    T = rigid_fit(points, truth)
    true = rms_mm(points @ T[:3, :3].mT + T[:3, 3] - truth)
    expected = 1e3 * result.expected.workspace
    size = str(result.lengths[0]) if result.lengths else ""
    wrong = len({one.row for one in result.outliers})
    words = "; ".join(filter(None, [words, f"{wrong} rows look wrong" * bool(wrong)]))
    silent = bool(true > 3 * expected and not words)
    return {"true_mm": true, "expected_mm": expected, "silent": silent, "said": words, "size": size}


def clean(seed: int) -> tuple[str, SimulatedArm, Campaign]:
    """A campaign without mistakes."""
    rng, how = np.random.default_rng([7, seed]), ("plain", "outliers", "heavy tails", "motions")[seed % 4]
    geometry, transmission, gravity = rng.uniform((0.5, 0.3, 0.3), (1.5, 2.0, 2.0)).tolist()
    sizes: dict[str, Any] = {"geometry": geometry, "transmission": transmission, "gravity": gravity}
    arm = SimulatedArm(seed, markers=int(rng.integers(1, 3)), noise=float(rng.choice([1e-5, 2e-5, 5e-5])), **sizes)
    count = int(rng.choice([40, 60, 100, 150]))
    q, y = arm.measure(count, seed=seed + 1)
    if how == "outliers":
        rows = torch.from_numpy(rng.choice(count, max(1, count // 20), replace=False))
        y = y.index_add(0, rows, noise(rng, y[rows], 2e-3))
    elif how == "heavy tails":
        y = arm.true_points(q) + arm.noise * torch.from_numpy(rng.standard_t(3, tuple(y.shape)))
    elif how == "motions":
        stops, steps = arm.sample(count // 6 + 2, seed), torch.arange(6, dtype=torch.float64)[:, None] / 6
        q = (stops[:-1, None] + (stops[1:] - stops[:-1])[:, None] * steps).flatten(0, 1)[:count]
        y = arm.true_points(q)
        y = y + noise(rng, y, arm.noise)
    return how, arm, of_tracker(arm, q, y)


def measure(arguments: argparse.Namespace) -> Iterator[Record]:
    """Yield the records."""
    first = arguments.first
    for seed in range(first, first + (arguments.clean or 0)):
        how, arm, campaign = clean(seed)
        yield {"mistake": f"none, {how}", "arm": seed} | judged(arm, campaign)
    if arguments.clean:
        return
    for name in arguments.mistakes or MISTAKES:
        for seed in range(first, first + (1 if arguments.quick else arguments.arms)):
            arm, rng = SimulatedArm(seed), np.random.default_rng([seed, 11])
            yield {"mistake": name, "arm": seed} | judged(arm, MISTAKES[name](arm, rng))


if __name__ == "__main__":
    harness.run(
        __doc__,
        measure,
        COLUMNS,
        arms=harness.number(5),
        clean=harness.number(None, "measure clean campaigns instead"),
        first={"type": int, "default": 0, "metavar": "N", "help": "number of the first arm or campaign"},
        mistakes={"nargs": "+", "metavar": "NAME", "choices": list(MISTAKES), "help": "which; all by default"},
    )
