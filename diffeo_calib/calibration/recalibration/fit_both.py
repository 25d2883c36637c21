"""The exact model of old and new rows, with the old scales.

The model is that of the robot as it is now. Old rows differ from it by shifts that they share: the places of device and
markers in their session, and what has drifted since. Devices that stand around the model are shared by the new rows.

Small changes of everything between two dates, whose sizes the new rows choose.

A test names what has changed clearly. Temperature, wear and new screws change everything a little. In each of three
groups, the geometry, the load and the transmissions of all joints, errors may differ from the old ones by s^2 times
their old prior variance; the sizes s^2 maximise the evidence of the new rows with a wide prior below one percent.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, log
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import RESIDUAL_TOLERANCE
from diffeo_calib.calibration.placing.place import coordinates_of
from diffeo_calib.calibration.recalibration.changed_parts import ChangedPart, Transmission, parts_of
from diffeo_calib.calibration.recalibration.changes import Drift
from diffeo_calib.calibration.recalibration.new_rows import NewRows, device_shifts
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.fitting.result import Fit, Progress
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap, SessionMarkers
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.noise import Noise, without_hidden
from diffeo_calib.maps.observation import LinearFunctionals, Observation, Part, Stacked
from diffeo_calib.regression.choose import MAX_DENSE
from diffeo_calib.robots.payload import joined_masses
from diffeo_calib.robots.placement import PLACES


def fit_both(rows: NewRows, drifts: list[Drift], progress: Progress) -> Fit:
    """The exact model of old and new rows with the old scales.

    All variances are inflated alike, which changes the uncertainty, but not the optimum.
    """
    factor, before = rows.inflation, rows.before
    old, nominal, count = before.fitted, before.nominal, len(rows)
    spec, theta = old.geodesic.spec, old.deformation.momenta.theta
    both, shared = _together(rows), _shared(rows, drifts)
    tool = rows.points.points - theta[nominal.geometry.slices["tool"]].view(-1, 3)
    newest = nominal.with_geometry(nominal.geometry.with_tool(tool))
    problem = Problem(
        newest,
        torch.cat([old.x, rows.q]),
        both.y,
        joint_kernel=spec.joint_kernel.scaled(factor),
        task_kernel=spec.task_kernel.scaled(factor),
        noise=Noise(factor * both.noise, factor**0.5 * _padded(shared, both.y.shape[1])),
        markers=nominal.geometry.markers,
        prior_variance=factor * _prior(rows),
        new_noise=factor * rows.new_noise,
        observe=both.observe,
    )
    problem = problem.with_nominal_of_rows(_sessions(rows, newest))
    solver = GaussNewton(tolerance=RESIDUAL_TOLERANCE)
    if old.data is not None or problem.y.numel() > MAX_DENSE:
        problem = problem.with_controls(torch.cat([old.deformation.x, rows.q]))
    b, p, _ = old.deformation.momenta.tensors
    start = Momenta(_with_zeros(b, count) / factor, _with_zeros(p, count * nominal.geometry.markers) / factor, theta)
    return fit(problem, solver, old.geodesic.integrator, start=start, progress=progress)


class Together(NamedTuple):
    """Old and new rows: numbers (N + M, R), m, their noise (N + M, R, R), and what they are of the points."""

    y: Tensor
    noise: Tensor
    observe: Observation | None


def _together(rows: NewRows) -> Together:
    """Old rows as what was measured of k1 to first order around the fit; the old fit's own numbers if it knows."""
    old, new_noise = rows.fitted, rows.weighted_noise
    if old.slopes is None and rows.observe is None:
        return Together(torch.cat([old.measured(), rows.y]), torch.cat([old.noise.covariance, new_noise]), None)
    A, y = old.linearised_rows()
    (N, r, m), (M, own) = A.shape, rows.y.shape
    size, first, new = max(r, own), torch.arange(N, device=y.device), torch.arange(N, N + M, device=y.device)
    whole = torch.arange(m, device=y.device)
    parts = [Part(first, whole, whole.new_tensor(range(r)), LinearFunctionals(A, torch.zeros_like(y)))]
    if isinstance(rows.observe, Stacked):
        parts += [Part(part.rows + N, part.points, part.numbers, part.observe) for part in rows.observe.parts]
    else:
        parts.append(coordinates_of(new, own, y))
    noise = torch.cat([_blocks(old.noise.covariance, size), _blocks(new_noise, size)])
    seen = torch.zeros(N + M, size, dtype=torch.bool, device=y.device)
    seen[:N, :r], seen[N:, :own] = old.noise.visible, rows.noise_model.coordinates(rows.y)
    numbers = torch.cat([torch.nn.functional.pad(values, (0, size - values.shape[1])) for values in (y, rows.y)])
    return Together(numbers, without_hidden(noise, seen), Stacked(N + M, size, m, parts))


def _blocks(noise: Tensor, size: int) -> Tensor:
    """Blocks (N, r, r) as the first ones of (N, R, R)."""
    rest = size - noise.shape[1]
    return torch.nn.functional.pad(noise, (0, rest, 0, rest))


def _padded(shared: tuple[Tensor, Tensor], size: int) -> Tensor:
    """Columns that old rows share and columns that new rows share, side by side: (N + M, R, c + c')."""
    old, new = (torch.nn.functional.pad(own, (0, 0, 0, size - own.shape[1])) for own in shared)
    c, own = old.shape[2], new.shape[2]
    return torch.cat([torch.nn.functional.pad(old, (0, own)), torch.nn.functional.pad(new, (c, 0))])


def _prior(rows: NewRows) -> Tensor:
    """Prior variances of theta; the base is free once a device says where it is."""
    prior = rows.fitted.geodesic.spec.prior_variance
    if rows.before.place is None:
        return prior
    base, free = rows.before.nominal.geometry.slices["base"], prior.clone()
    free[base] = prior[base].clamp(min=PLACES.found_m_rad**2)
    return free


def _shared(rows: NewRows, drifts: list[Drift]) -> tuple[Tensor, Tensor]:
    """(N, r, c) shifts of the old rows: those they shared already, device and markers since, what has drifted since.

    And (M, R, c') those of the new ones: places of their devices.
    """
    old, fitted = rows.fitted, rows.before.nominal
    points = FlangePoints(fitted, fitted.geometry.tool, same=True)
    places = old.measured() if old.slopes is None else old.fitted_points
    around = {"centre": rows.centre, "marker_deviation": rows.marker_deviation}
    at = old.geodesic.with_nominal(points).linearise(old.x)
    moved = device_shifts(rows.before, points, at, places=places.unflatten(1, (-1, 3)), **around)
    columns = [old.noise.shared, moved if old.slopes is None else old.slopes @ moved]
    if drifts:
        at = old.geodesic.linearise(None if old.data is None else old.x)
        at = at if old.slopes is None else at.projected(old.slopes)
        columns += [each.variance**0.5 * each.part.root(at) for each in drifts]
    return torch.cat(columns, 2), rows.by_devices


def _sessions(rows: NewRows, newest: GeometryMap) -> SessionMarkers:
    """k0 at the controls: every session with its own markers, every row with its own payload."""
    known, x, count = rows.fitted.geodesic.spec.at_controls, rows.fitted.deformation.x, len(rows)
    session, tools = torch.zeros(len(x), dtype=torch.int64, device=x.device), rows.before.nominal.geometry.tool[None]
    by_row = known
    if isinstance(known, SessionMarkers):
        session, tools, by_row = known.session, known.tools, known.nominal
    latest = torch.full((count,), len(tools), dtype=torch.int64, device=x.device)
    if isinstance(by_row, GeometryMap):
        newest = newest.under(joined_masses(by_row.payload, rows.points.fitted.payload))
    return SessionMarkers(newest, torch.cat([session, latest]), torch.cat([tools, newest.geometry.tool[None]]))


def _with_zeros(values: Tensor, count: int) -> Tensor:
    """With rows of zeros at the end."""
    return torch.cat([values, values.new_zeros(count, *values.shape[1:])])


USUAL_SIZE, EFOLDS = exp(-6.0), 2.5
"""Log-normal prior of s^2: its centre, and the standard deviation of its logarithm."""
STARTS = log(USUAL_SIZE), -3.0
"""Of the search, logarithms of s^2: hardly any change, and a clear one."""
LEAST_GAIN = 4.0
"""Log evidence by which drift must explain the rows better: what chance exceeds in one of twenty, for three sizes."""
LEAST_GAIN_OF_INLIERS = 0.5
"""The same where rows that do not fit the old model have hardly any weight: outliers look like a change."""
LOG_VARIANCE_RANGE = -12.0, 4.0
"""Of the logarithm of s^2."""


def usual_drift(rows: NewRows, named: Sequence[Drift]) -> list[Drift]:
    """What may differ between the dates, besides what a test named.

    Args:
        rows: the new rows as the old model sees them. named: parts that have changed, which are free already.
    """
    free = {each.part.name for each in named}
    groups: dict[str, list[ChangedPart]] = {}
    for part in parts_of(rows):
        if part.name not in free:
            groups.setdefault("transmissions" if isinstance(part, Transmission) else part.name, []).append(part)
    if not groups:
        return []
    roots = [torch.cat([part.root(rows.at) for part in parts], 2).flatten(0, 1) for parts in groups.values()]
    known = [each.variance**0.5 * each.part.root(rows.at) for each in named]
    doubted = rows.if_drifting([*known, *(root.view(*rows.y.shape, -1) for root in roots)])
    base = rows.posterior if not known else rows.if_drifting(known).posterior
    residual, sizes = rows.residual.flatten(), None
    for weighed, gain in ((rows, LEAST_GAIN_OF_INLIERS), (doubted, LEAST_GAIN)):
        sizes = _likeliest(Noise(weighed.weighted_noise).add_to(base), roots, residual, gain)
        if sizes is None:
            return []
    return [Drift(part, size) for parts, size in zip(groups.values(), sizes or [], strict=True) for part in parts]


def _likeliest(covariance: Tensor, roots: list[Tensor], residual: Tensor, gain: float) -> list[float] | None:
    """The sizes s^2 of changes with these columns (M R, c) beside a covariance (M R, M R) that is known, m^2.

    None where changes explain the residuals by less than ``gain`` better, in log evidence.
    """
    from scipy.optimize import minimize  # noqa: PLC0415  # slow to import, not needed to use a model

    grams = [root @ root.T for root in roots]

    def objective(vector: np.ndarray) -> tuple[float, np.ndarray]:
        logs = torch.from_numpy(vector)
        total = covariance + sum((float(size) * gram for size, gram in zip(logs.exp(), grams, strict=True)), 0.0)
        factor = torch.linalg.cholesky(total)
        mu = torch.cholesky_solve(residual[:, None], factor)[:, 0]
        slope = 0.5 * (torch.cholesky_inverse(factor) - torch.outer(mu, mu))
        away = (logs - log(USUAL_SIZE)) / EFOLDS
        value = 0.5 * residual @ mu + factor.diagonal().log().sum() + 0.5 * away.square().sum()
        by_size = torch.stack([(slope * gram).sum() for gram in grams]) * logs.exp() + away / EFOLDS
        return float(value), by_size.numpy()

    bounds = [LOG_VARIANCE_RANGE] * len(grams)
    starts = [np.full(len(grams), start) for start in STARTS]
    found = [minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
    best = min(found, key=lambda each: float(each.fun))
    still, _ = objective(np.full(len(grams), LOG_VARIANCE_RANGE[0]))
    prior = 0.5 * len(grams) * ((LOG_VARIANCE_RANGE[0] - log(USUAL_SIZE)) / EFOLDS) ** 2
    if still - prior - float(best.fun) < gain:
        return None
    return [exp(value) for value in best.x.tolist()]
