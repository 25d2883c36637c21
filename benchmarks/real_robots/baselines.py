"""Calibration methods: the package's, and peers on the same measurements.

    registration          base frame and markers only; the robot's nominal kinematics are kept
    joint offsets         plus one constant offset per joint, which most controllers can store
    geometry              plus all geometric errors, with a prior: the classical calibration
    geometry + GP         geometry, and a Gaussian process per coordinate on its residual
    geometry + boosting   geometry, and gradient boosted trees on its residual
    geometry + network    geometry, and a small neural network on its residual
    GP alone              a Gaussian process per coordinate from joints to points, without a robot
    diffeo_calib          `dc.calibrate` with all its defaults

The inputs of a learner are cos and sin of each turning joint (for trees also the joints themselves). Its settings come
from the training data alone: for Gaussian processes by marginal likelihood (the likelier of two kernels), otherwise by
cross-validation that keeps repeated configurations together. Several markers are more coordinates to predict.
On 150 and 442 poses of a UR10 these settings were the best of those tried: length scales per input instead of per joint
(except for 150 poses), stochastic boosting of deep trees instead of histogram boosting, several networks by L-BFGS
instead of one network, or Adam.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.robots.geometry import Geometry

Kinematics = Callable[[Tensor], Tensor]
"""(N, n) joint values -> (N, P, 3) markers in m."""

MOST_SELECTED, MOST_ROWS = 600, 4000
"""Most rows for the choice of a learner's settings, and for a Gaussian process: they bound its time to minutes."""
OFFSET_PRIOR = 0.03
"""Prior standard deviation of a joint offset [rad or m], larger than any controller's. Without it, poses that hardly
turn a wrist joint give it an offset of 0.1 rad: on one of five splits of a UR10 with 60 poses the held-out RMS was
3.4 mm, with the prior 0.8 mm."""
OFFSET_ROUNDS, FINEST_NOISE = 3, 1e-6
RESTARTS = 1
FOLDS = 5
TREES = {"n_estimators": 300, "learning_rate": 0.05, "subsample": 0.5, "min_samples_leaf": 3}
GRID_TREES = {"max_depth": (3, 5, 7), "max_features": (0.5, None)}
GRID_NETWORK = {
    "activation": ("tanh", "relu"),
    "hidden_layer_sizes": ((64,), (64, 64)),
    "alpha": (1.0, 3.0, 10.0, 30.0),
}
NETWORK_STEPS, NETWORKS = 1000, 5


@dataclass(frozen=True)
class Fitted:
    """Result of a method: kinematics, a remark, and optionally mean and covariance of new measurements."""

    kinematics: Kinematics
    note: str | None = None
    predict: Callable[[Tensor], tuple[Tensor, Tensor]] | None = None


def registration(robot: dc.Chain, train: dc.Measurements, seed: int) -> Fitted:
    """Base and markers."""
    return Fitted(register(robot, train.q, train.points).geometry.points)


def joint_offsets(robot: dc.Chain, train: dc.Measurements, seed: int) -> Fitted:
    """Base, markers and a constant offset of every joint."""
    return Fitted(with_offsets(robot, train)[0].points)


def geometry(robot: dc.Chain, train: dc.Measurements, seed: int) -> Fitted:
    """All geometric errors."""
    return Fitted(identified(robot, train).points)


def geometry_and_process(robot: dc.Chain, train: dc.Measurements, seed: int) -> Fitted:
    """Gaussian processes on the residual of the geometry."""
    return corrected(identified(robot, train).points, robot, train, seed, processes)


def process_alone(robot: dc.Chain, train: dc.Measurements, seed: int) -> Fitted:
    """Gaussian processes on the measured points."""

    def nothing(q: Tensor) -> Tensor:
        return torch.zeros(len(q), train.markers, 3, dtype=torch.float64)

    return corrected(nothing, robot, train, seed, processes)


def geometry_and_boosting(robot: dc.Chain, train: dc.Measurements, seed: int) -> Fitted:
    """Boosted trees on the residual of the geometry."""
    return corrected(identified(robot, train).points, robot, train, seed, boosting)


def geometry_and_network(robot: dc.Chain, train: dc.Measurements, seed: int) -> Fitted:
    """A network on the residual of the geometry."""
    return corrected(identified(robot, train).points, robot, train, seed, network)


def diffeomorphic(robot: dc.Chain, train: dc.Measurements, seed: int) -> Fitted:
    """The package."""
    result = dc.calibrate(robot, train)
    return Fitted(result.model, None if result.fit.converged else result.status, result.model.predict)


Method = Callable[[dc.Chain, dc.Measurements, int], Fitted]
METHODS: dict[str, Method] = {
    "registration": registration,
    "joint offsets": joint_offsets,
    "geometry": geometry,
    "geometry + GP": geometry_and_process,
    "geometry + boosting": geometry_and_boosting,
    "geometry + network": geometry_and_network,
    "GP alone": process_alone,
    "diffeo_calib": diffeomorphic,
}


# --- geometry -----------------------------------------------------------------------------------------------------


def identified(robot: dc.Chain, train: dc.Measurements) -> Geometry:
    """Return the full geometric calibration."""
    start = register(robot, train.q, train.points).geometry
    return identify(start, train.q, train.points).geometry


def with_offsets(robot: dc.Chain, train: dc.Measurements) -> tuple[Geometry, np.ndarray]:
    """Fit base, markers and joint offsets by least squares, with a weak prior on the offsets.

    Returns:
        the geometry, and the offsets (n,) [rad or m]. Offsets that base or markers can replace (often the first
        joint's and the last one's) are near zero.
    """
    start = register(robot, train.q, train.points)
    free = _directions(start.geometry)  # (K, 6 + n + 3 P)
    noise, found = start.noise, np.zeros(free.shape[1])
    for _ in range(OFFSET_ROUNDS):
        found = _offset_fit(start.geometry, train, free, max(noise, FINEST_NOISE))
        error = start.geometry.points(train.q, free @ torch.from_numpy(found)) - train.points
        noise = float(error.square().mean().sqrt())
    return start.geometry.absorb(free @ torch.from_numpy(found)), found[6 : 6 + robot.n]


def _offset_fit(start: Geometry, train: dc.Measurements, free: Tensor, noise: float) -> np.ndarray:
    """Most probable base, offsets and markers (6 + n + 3 P,) for a given standard deviation of a coordinate."""
    from scipy.optimize import least_squares  # noqa: PLC0415  # slow to import

    n = start.chain.n
    pull = np.eye(free.shape[1])[6 : 6 + n] / OFFSET_PRIOR  # (n, 6 + n + 3 P)

    def residual(u: np.ndarray) -> np.ndarray:
        error = (start.points(train.q, free @ torch.from_numpy(u)) - train.points) / noise
        return np.concatenate([error.flatten().numpy(), pull @ u])

    def slopes(u: np.ndarray) -> np.ndarray:
        part = (start.sensitivities(train.q, free @ torch.from_numpy(u)) @ free) / noise
        return np.vstack([part.flatten(0, 2).numpy(), pull])

    jacobian: Any = slopes  # scipy's stubs accept names of difference schemes only
    return least_squares(residual, np.zeros(free.shape[1]), jacobian, xtol=1e-12, ftol=1e-12, gtol=1e-12).x


def _directions(start: Geometry) -> Tensor:
    """Directions (K, 6 + n + 3 P) of the free parameters: base, twist of each joint along its own motion, markers."""
    n, parts = start.chain.n, start.slices
    free = torch.zeros(start.size, 6 + n + 3 * start.markers, dtype=torch.float64)
    free[parts["base"], :6] = torch.eye(6, dtype=torch.float64)
    for joint, (axis, turns) in enumerate(zip(start.chain.axes, start.chain.revolute, strict=True)):
        row = 6 + 6 * joint + (3 if turns else 0)  # a twist's translation comes first
        free[row : row + 3, 6 + joint] = axis
    free[parts["tool"], 6 + n :] = torch.eye(3 * start.markers, dtype=torch.float64)
    return free


# --- learners -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """Data of a learner: (N, D) inputs, (N, m) targets of mean 0 and deviation 1, and labels (N,) of repeats.

    `owner` (D,) is the joint that each input comes from, `q` (N, n) the joints themselves.
    """

    inputs: np.ndarray
    targets: np.ndarray
    groups: np.ndarray
    owner: np.ndarray
    q: np.ndarray
    seed: int


Predict = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Inputs (M, D) and joints (M, n) -> targets (M, m)."""
Learner = Callable[[Table], tuple[Predict, str | None]]


def corrected(start: Kinematics, robot: dc.Chain, train: dc.Measurements, seed: int, learn: Learner) -> Fitted:
    """Return kinematics plus a learner's prediction of its residual."""
    centre, spread = train.q.mean(0), train.q.std(0).clamp(min=1e-9)
    residual = (train.points - start(train.q)).detach().flatten(1).numpy()
    mean, scale = residual.mean(0), np.maximum(residual.std(0), 1e-12)
    inputs, owner = embedded(robot, train.q, centre, spread)
    table = Table(inputs, (residual - mean) / scale, train.groups().numpy(), owner, train.q.numpy(), seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a scale at its bound or a solver at its limit is no failure
        predict, note = learn(table)

    def kinematics(q: Tensor) -> Tensor:
        found = predict(embedded(robot, q, centre, spread)[0], q.numpy())
        return start(q) + torch.from_numpy(mean + scale * found).reshape(len(q), -1, 3)

    return Fitted(kinematics, note)


def embedded(robot: dc.Chain, q: Tensor, centre: Tensor, spread: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs (N, D), cos and sin of a turning joint, a standardised slide, and the joint (D,) of each input."""
    columns, owner = [], []
    for joint, turns in enumerate(robot.periodic):
        value = q[:, joint]
        own = [value.cos(), value.sin()] if turns else [(value - centre[joint]) / spread[joint]]
        columns += own
        owner += [joint] * len(own)
    return torch.stack(columns, dim=1).numpy(), np.array(owner)


def processes(table: Table) -> tuple[Predict, str | None]:
    """One Gaussian process per coordinate."""
    rows = _some(table, MOST_ROWS)
    found = [_process(table, target, rows) for target in table.targets.T]
    notes = [_selected_note(table), f"conditioned on {len(rows)} rows" if len(rows) < len(table.inputs) else None]
    note = "; ".join(text for text in notes if text) or None
    return lambda inputs, _: np.column_stack([one.predict(inputs) for one in found]), note


def _some(table: Table, most: int) -> np.ndarray:
    """A random subset of at most `most` rows."""
    return np.random.default_rng(table.seed).permutation(len(table.inputs))[:most]


def _selected_note(table: Table) -> str | None:
    rows = len(table.inputs)
    return f"settings chosen on {MOST_SELECTED} of {rows} training rows" if rows > MOST_SELECTED else None


def _process(table: Table, target: np.ndarray, rows: np.ndarray) -> Any:
    """A process with the likelier one of two kernels, with a length scale per input."""
    from sklearn.gaussian_process import GaussianProcessRegressor  # noqa: PLC0415  # optional, and slow to import
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel  # noqa: PLC0415

    process: Any = GaussianProcessRegressor  # stubs of scikit-learn infer types from its defaults
    start: Any = np.full(table.inputs.shape[1], 2.0)
    bounds = (0.1, 1e3)
    selected = _some(table, MOST_SELECTED)
    fits = [
        process(
            ConstantKernel(1.0, (1e-3, 1e5)) * shape + WhiteKernel(0.1, (1e-9, 10.0)),
            normalize_y=True,
            n_restarts_optimizer=RESTARTS,
            random_state=table.seed,
        ).fit(table.inputs[selected], target[selected])
        for shape in (RBF(start, bounds), Matern(start, bounds, nu=2.5))
    ]
    best: Any = max(fits, key=lambda fit: fit.log_marginal_likelihood_value_)
    if len(rows) == len(selected):
        return best
    again = process(best.kernel_, normalize_y=True, optimizer=None)
    return again.fit(table.inputs[rows], target[rows])


def boosting(table: Table) -> tuple[Predict, str | None]:
    """Boosted trees per coordinate; their inputs include the joints themselves."""
    from sklearn.ensemble import GradientBoostingRegressor  # noqa: PLC0415

    inputs = np.hstack([table.inputs, table.q])
    trees = GradientBoostingRegressor(**TREES, random_state=table.seed)
    found = [_searched(trees, GRID_TREES, table, inputs, target).fit(inputs, target) for target in table.targets.T]
    note = _selected_note(table)
    return lambda inputs, q: np.column_stack([one.predict(np.hstack([inputs, q])) for one in found]), note


def network(table: Table) -> tuple[Predict, str | None]:
    """The mean of several networks with different initial weights, each for all coordinates."""
    from sklearn.neural_network import MLPRegressor  # noqa: PLC0415

    inputs, targets = table.inputs, table.targets
    net = MLPRegressor(solver="lbfgs", max_iter=NETWORK_STEPS, random_state=table.seed)
    best = _searched(net, GRID_NETWORK, table, inputs, targets)
    found: list[Any] = [
        deepcopy(best).set_params(random_state=table.seed + k).fit(inputs, targets) for k in range(NETWORKS)
    ]
    note = _selected_note(table)
    return lambda inputs, _: np.mean([one.predict(inputs) for one in found], axis=0), note


def _searched(
    model: Any, grid: Mapping[str, Sequence[object]], table: Table, inputs: np.ndarray, targets: np.ndarray
) -> Any:
    """The unfitted model with the settings that predict best across folds."""
    from sklearn.model_selection import GridSearchCV, GroupKFold  # noqa: PLC0415

    rows = _some(table, MOST_SELECTED)
    groups = table.groups[rows]
    folds = GroupKFold(min(FOLDS, len(np.unique(groups))), shuffle=True, random_state=table.seed)
    options: Any = {"scoring": "neg_mean_squared_error", "error_score": "raise", "refit": False}
    search = GridSearchCV(model, dict(grid), cv=folds, **options)
    return deepcopy(model).set_params(**search.fit(inputs[rows], targets[rows], groups=groups).best_params_)
