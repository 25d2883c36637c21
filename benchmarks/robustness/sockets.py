"""Calibration without a measuring device: a ball on the tool in the sockets of a block, on real and simulated robots.

    python benchmarks/robustness/sockets.py --out sockets.json          # DIFFEO_CALIB_DATA names the folder with mukca/

Real robots (MUKCa, Franzese et al. 2025): each place is left out in turn; `spread_mm` is the RMS distance of its rows
from the middle of their socket, `distance_mm` the mean error of the known 50 mm. These are no accuracies.

Simulated arm: `rms_mm` is the RMS error at 1000 random configurations without noise after the best rigid motion,
`coverage` the share of them within the predicted 95 % region. `sockets` rows are 6 places x 2 sockets x 20 rows unless
`case` says otherwise; `tracker` rows are the same configurations, or as many random ones, with the same error per
coordinate.

Mixtures: a tracker that sees another marker in 20 or 60 random configurations, 120 or 240 rows of the ball in sockets,
and both in one table; errors of the marker and of the ball as above, each after its best rigid motion.

Methods: `nominal`, `authors` (their published objective with all terms: variance within sockets, distortion,
regularisation; on an error twist before every joint), `geometry`, `full`.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import os
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator

import harness
import numpy as np
import torch
from harness import Record
from held_out import covered, rms_mm
from scipy.optimize import least_squares
from simulated_sockets import rest_in_sockets
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import rigid_fit

COLUMNS = ("robot", "case", "repeatability_mm", "seed", "method", "rows", "spread_mm", "distance_mm", "rms_mm")
COLUMNS += ("coverage", "expected_mm")
ROBOTS = {"panda_3": ("panda.urdf", "panda_link0"), "kuka_14": ("iiwa14.urdf", "base_link")}
DISTANCES, DISTANCE_STD = {("0", "1"): 0.05}, 3e-5
REGULARISATION = 1e-4
"""Weight of the squared parameters in the authors' objective."""
TRACKED, IN_SOCKETS = (20, 60), (120, 240)
"""Rows of mixtures."""
Points = Callable[[Tensor], Tensor]


def authors(start: Geometry, data: dc.Measurements) -> Geometry:
    """Minimise, over twists of joints and the ball, the sum over places of variance, distortion and regularisation."""
    socket, places, free = data.device, data.sockets.place, slice(6, start.size)
    own = torch.nn.functional.one_hot(socket).double()
    mean = own / own.sum(0)  # (N, S)
    per_row = torch.bincount(places[socket]).double()[places[socket]].rsqrt()
    root = (len(data.sockets.place_names) * REGULARISATION) ** 0.5
    regular = torch.full((start.size - 6,), root, dtype=torch.float64)
    regular[-3:] = 0.0  # the ball is free

    def parts(u: np.ndarray) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        theta = torch.cat([torch.zeros(6, dtype=torch.float64), torch.from_numpy(u)])
        points, slopes = start.points(data.q, theta)[:, 0], start.sensitivities(data.q, theta)[:, 0, :, free]
        return points, slopes, mean.mT @ points, torch.einsum("ns,nck->sck", mean, slopes)

    def residual(u: np.ndarray) -> np.ndarray:
        points, _, middle, _ = parts(u)
        away = per_row[:, None] * (points - middle[socket])
        far = [float((middle[a] - middle[b]).norm()) - d for a, b, d in data.sockets.distances]
        return np.concatenate([away.flatten().numpy(), np.array(far), (regular * torch.from_numpy(u)).numpy()])

    def jacobian(u: np.ndarray) -> np.ndarray:
        _, slopes, middle, moved = parts(u)
        rows = [(per_row[:, None, None] * (slopes - moved[socket])).flatten(0, 1)]
        for a, b, _ in data.sockets.distances:
            along = middle[a] - middle[b]
            rows.append((along / along.norm() @ (moved[a] - moved[b]))[None])
        return torch.cat([*rows, regular.diag()]).numpy()

    found = least_squares(residual, np.zeros(start.size - 6), jacobian, x_scale="jac", max_nfev=200)  # pyright: ignore
    return start.absorb(torch.cat([torch.zeros(6, dtype=torch.float64), torch.from_numpy(found.x)]))


def calibrated(robot: dc.Tree, data: dc.Measurements) -> tuple[dc.CalibrationResult, dict[str, Points]]:
    """A calibration, and the kinematics of every method."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = dc.calibrate(robot, data)
    start = result.registration.geometry
    others = {"nominal": start.points, "authors": authors(start, data).points}
    return result, {**others, "geometry": result.identification.geometry.points, "full": result.model}


def read(name: str, folder: Path) -> tuple[dc.Tree, dc.Measurements]:
    """A robot and its rows."""
    urdf, base = ROBOTS[name]
    robot = dc.load_urdf(folder / urdf, base, "ball_link")
    known = {"distances": DISTANCES, "distance_std": DISTANCE_STD}
    rows = {"length": "m", "angle": "rad", "duplicates": "keep"}
    return robot, dc.read_measurements(folder / f"{name}.csv", robot, socket=["place", "socket"], **rows, **known)


def real(name: str, folder: Path) -> Iterator[Record]:
    """Every place of a robot left out."""
    robot, data = read(name, folder)
    place, totals = data.places, dict[str, list[tuple[int, float, float]]]()
    for number, left_out in enumerate(data.sockets.place_names):
        result, methods = calibrated(robot, data.rows(place != number))
        test = data.rows(place == number)
        expected = None if result.sockets is None else 1e3 * result.expected.workspace
        for method, points in methods.items():
            found = dc.evaluate(points, test)
            distance = float(np.mean([abs(one.error) for one in found.distances]))
            totals.setdefault(method, []).append((len(test), found.rms, distance))
            record: Record = {"robot": name, "case": f"without {left_out}", "method": method, "rows": len(test)}
            record |= {"spread_mm": 1e3 * found.rms, "distance_mm": 1e3 * distance}
            yield record | {"expected_mm": expected if method == "full" else None}
    for method, parts in totals.items():
        counts, spreads, distances = (np.array(column) for column in zip(*parts, strict=True))
        pooled = float(np.sqrt((counts * spreads**2).sum() / counts.sum()))
        record = {"robot": name, "method": method, "rows": int(counts.sum())}
        yield record | {"case": "mean", "spread_mm": 1e3 * spreads.mean(), "distance_mm": 1e3 * distances.mean()}
        yield record | {"case": "pooled", "spread_mm": 1e3 * pooled, "distance_mm": 1e3 * distances.mean()}


def aligned(points: Tensor, truth: Tensor) -> Tensor:
    """Errors (N, 3) of points after the best rigid motion."""
    T = rigid_fit(points, truth)
    return points @ T[:3, :3].mT + T[:3, 3] - truth


def judged(arm: SimulatedArm, methods: dict[str, Points], record: Record, seed: int) -> Iterator[Record]:
    """Errors of each method over the workspace, and the coverage of the model."""
    q = arm.sample(1000, seed + 100)
    truth = arm.true_points(q)[:, 0]
    for method, points in methods.items():
        errors = aligned(points(q)[:, 0].detach(), truth)
        found: Record = {"method": method, "rms_mm": rms_mm(errors)}
        if isinstance(points, dc.CalibratedKinematics):
            covariance = points.predict(q, noise=False)[1][:, 0]
            found["coverage"] = covered(errors, covariance)
            found["expected_mm"] = 1e3 * float(covariance.diagonal(dim1=1, dim2=2).sum(1).mean().sqrt())
        yield record | found


def simulated(seed: int, repeatability: float, case: str, **block: float) -> Iterator[Record]:
    """Sockets of one arm; for the standard case also a tracker."""
    arm = SimulatedArm(seed)
    rows = rest_in_sockets(arm, seed, repeatability=repeatability, **block)  # pyright: ignore[reportArgumentType]
    known, std = {("0", "1"): 0.05}, 1e-5
    if case == "places known":  # to a tenth of a millimetre, such as holes of a table: all distances of first sockets
        first = [name for name in rows.positions if name.endswith("/0")]
        pairs = [(a, b) for k, a in enumerate(first) for b in first[k + 1 :]]
        known |= {(a, b): float((rows.positions[a] - rows.positions[b]).norm()) for a, b in pairs}
        std = 1e-4
    data = dc.Measurements.from_sockets(rows.q, rows.names, arm.nominal.joint_names, distances=known, distance_std=std)
    _, methods = calibrated(arm.nominal, data)
    record: Record = {"robot": "simulated arm", "repeatability_mm": 1e3 * repeatability, "seed": seed}
    methods = methods if case == "sockets" else {name: methods[name] for name in ("geometry", "full")}
    yield from judged(arm, methods, record | {"case": case, "rows": len(data)}, seed)
    if case != "sockets":
        return
    draws = np.random.default_rng([seed, 9]).standard_normal((2, len(data), 1, 3))
    for kind, q, draw in (("same", rows.q, draws[0]), ("random", arm.sample(len(data), seed + 50), draws[1])):
        seen = dc.Measurements(q, arm.true_points(q) + repeatability * torch.from_numpy(draw), arm.nominal.joint_names)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = dc.calibrate(arm.nominal, seen).model
        where = {"case": f"tracker, {kind} configurations", "rows": len(data)}
        yield from judged(arm, {"full": model}, record | where, seed)


def mixtures(seed: int) -> Iterator[Record]:
    """Few measured positions and many rows in sockets, by themselves and together."""
    arm, noise, repeatability = SimulatedArm(seed, markers=2), 2e-5, 5e-5  # marker 0 is the ball
    q = arm.sample(max(TRACKED), seed + 50)
    draws = noise * torch.from_numpy(np.random.default_rng([seed, 9]).standard_normal((len(q), 1, 3)))
    seen = dc.Measurements(q, arm.true_points(q)[:, 1:] + draws, arm.nominal.joint_names)
    resting = {}
    for count in IN_SOCKETS:
        rows = rest_in_sockets(arm, seed, rows=count // 12, repeatability=repeatability)
        known = {"distances": {("0", "1"): 0.05}, "distance_std": 1e-5}
        resting[count] = dc.Measurements.from_sockets(rows.q, rows.names, arm.nominal.joint_names, **known)
    tables = {f"tracker {count}": (seen.rows(slice(count)), (1,)) for count in TRACKED}
    tables |= {f"sockets {count}": (data, (0,)) for count, data in resting.items()}
    for count in TRACKED:
        for other, data in resting.items():
            both = dc.Measurements.joined([seen.rows(slice(count)), data])
            tables[f"tracker {count} + sockets {other}"] = both, (1, 0)
    q = arm.sample(1000, seed + 100)
    truth = arm.true_points(q)
    for case, (data, points) in tables.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = dc.calibrate(arm.nominal, data).model
        mean, covariance = model.predict(q, noise=False)
        for number, point in enumerate(points):
            errors, own = aligned(mean[:, number], truth[:, point]), covariance[:, number]
            found: Record = {"method": ("ball", "marker")[point], "rms_mm": rms_mm(errors)}
            found |= {"coverage": covered(errors, own), "rows": len(data), "case": case, "seed": seed}
            found["expected_mm"] = 1e3 * float(own.diagonal(dim1=1, dim2=2).sum(1).mean().sqrt())
            yield {"robot": "simulated arm", "repeatability_mm": 1e3 * repeatability} | found


def tried(seed: int, case: str, **block: float) -> Iterator[Record]:
    """The records of a case; one that says why, if the arm cannot reach a socket often enough."""
    try:
        yield from simulated(seed, 5e-5, case, **block)
    except NumericalError as error:
        yield {"robot": "simulated arm", "case": case, "seed": seed, "method": f"not run: {error}"}


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every case and method."""
    folder = Path(os.environ.get("DIFFEO_CALIB_DATA", "")) / "mukca"
    if "real" in plan.parts:
        for name in ROBOTS:
            if folder.is_dir():
                yield from real(name, folder)
            else:
                print(f"{name}: left out, DIFFEO_CALIB_DATA names no folder with mukca/", file=sys.stderr)
    for seed in range(plan.first, plan.first + plan.seeds):
        if "simulated" in plan.parts:
            for repeatability in plan.repeatability:
                yield from simulated(seed, 1e-3 * repeatability, "sockets")
        if "mixtures" in plan.parts:
            yield from mixtures(seed)
        if "advice" in plan.parts:
            yield from tried(seed, "3 places", places=3)
            yield from tried(seed, "3 places, 40 rows each", places=3, rows=40)
            yield from tried(seed, "12 places, 10 rows each", places=12, rows=10)
            yield from tried(seed, "tilt 30 degrees", tilt=30.0)
            yield from tried(seed, "places known")


if __name__ == "__main__":
    options = {"seeds": harness.number(3), "parts": harness.names(["real", "simulated", "advice", "mixtures"])}
    options["first"] = {"type": int, "default": 0, "metavar": "SEED"}
    options["repeatability"] = {"nargs": "+", "type": float, "default": [0.02, 0.05, 0.1], "metavar": "MM"}
    quick = {"seeds": 1, "repeatability": [0.05], "parts": ["simulated"]}
    harness.run(__doc__, measure, COLUMNS, quick=quick, **options)
