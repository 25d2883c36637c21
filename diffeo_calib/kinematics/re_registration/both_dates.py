"""Rows of a new set-up beside those of a fit: one problem, with the old scales, of the robot as it is now.

Old rows differ from this robot by shifts that they share: the places of device and markers in their session, and what
has drifted since. These are part of their noise (:class:`Noise`): nothing but the rows' covariance knows of sessions.
The old rows follow from the old momenta (:meth:`FittedMap.measured`), from which the search starts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap, SessionMarkers
from diffeo_calib.kinematics.re_registration.new_rows import NewRows
from diffeo_calib.kinematics.re_registration.registered_map import place_slopes, robot_map
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise, without_hidden
from diffeo_calib.maps.observation import LinearFunctionals, Observation, Part, Stacked
from diffeo_calib.regression.choose import MAX_DENSE
from diffeo_calib.robots.payload import joined_masses
from diffeo_calib.robots.placement import PLACES


def joins(old: FittedMap, count: int) -> bool:
    """Whether old rows tell coordinates, and as many new ones leave their matrix dense if it is."""
    N, m = len(old.x), old.m
    return old.slopes is None and (old.data is not None or not N * m <= MAX_DENSE < (N + count) * m)


def both_dates(
    new: NewRows, factor: float, drifts: Sequence[Callable[[Linearisation], Tensor]] = ()
) -> tuple[Problem, Momenta]:
    """The problem of old and new rows, and the old momenta as its start.

    Args:
        new: the rows. factor: on all variances, which changes the uncertainty, but not the optimum.
        drifts: columns (N, r, c) of what old rows share besides places, m, from their linearisation.
    """
    old, count = new.fitted, len(new)
    spec, (b, p, theta), x = old.geodesic.spec, old.deformation.momenta.tensors, old.deformation.x
    nominal = robot_map(old).typical
    geometry = nominal.geometry
    newest = nominal.with_geometry(geometry.with_tool(new.points.points - theta[geometry.slices["tool"]].view(-1, 3)))
    prior = spec.prior_variance.clone()
    if bool(new.deviations[:6].any()):  # a device says where the base is
        prior[geometry.slices["base"]] = prior[geometry.slices["base"]].clamp(min=PLACES.found_m_rad**2)
    y, noise, observe = _together(new)
    before, rows = _shared(nominal, new, drifts), y.shape[1]
    before = pad(before, (0, new.shared.shape[2], 0, rows - before.shape[1]))
    since = pad(new.shared, (before.shape[2] - new.shared.shape[2], 0, 0, rows - new.shared.shape[1]))
    problem = Problem(
        newest,
        torch.cat([old.x, new.q]),
        y,
        joint_kernel=spec.joint_kernel.scaled(factor),
        task_kernel=spec.task_kernel.scaled(factor),
        noise=Noise(factor * noise, factor**0.5 * torch.cat([before, since])),
        markers=geometry.markers,
        prior_variance=factor * prior,
        new_noise=factor * new.new_noise,
        observe=observe,
    )
    problem = problem.with_nominal_of_rows(_sessions(geometry.tool, new, newest))
    if old.data is not None or problem.y.numel() > MAX_DENSE:
        problem = problem.with_controls(torch.cat([x, new.q]))
    b, p = pad(b, (0, 0, 0, count)) / factor, pad(p, (0, 0, 0, count * geometry.markers)) / factor
    return problem, Momenta(b, p, theta)


def _together(new: NewRows) -> tuple[Tensor, Tensor, Observation | None]:
    """Numbers (N + M, R), m, their noise (N + M, R, R), and what they are of the points.

    Old rows are what was measured of k1 to first order around the fit; the old fit's own numbers if it knows.
    """
    old, own_noise = new.fitted, new.weighted_noise
    if old.slopes is None and new.observe is None:
        return torch.cat([old.measured(), new.y]), torch.cat([old.noise.covariance, own_noise]), None
    A, y = old.linearised_rows()
    (N, r, m), (M, own) = A.shape, new.y.shape
    size, rows = max(r, own), torch.arange(N + M, device=y.device)
    parts = [Part(rows[:N], torch.arange(m, device=y.device), torch.arange(r, device=y.device), LinearFunctionals(A))]
    if isinstance(new.observe, Stacked):
        parts += [Part(part.rows + N, part.points, part.numbers, part.observe) for part in new.observe.parts]
    else:
        parts.append(Part.of_coordinates(rows[N:], own))
    noise = [pad(each, 2 * (0, size - each.shape[1])) for each in (old.noise.covariance, own_noise)]
    seen = torch.cat([pad(each, (0, size - each.shape[1])) for each in (old.noise.visible, new.visible)])
    numbers = torch.cat([pad(values, (0, size - values.shape[1])) for values in (y, new.y)])
    return numbers, without_hidden(torch.cat(noise), seen), Stacked(N + M, size, m, parts)


def _shared(nominal: GeometryMap, new: NewRows, drifts: Sequence[Callable[[Linearisation], Tensor]]) -> Tensor:
    """(N, r, c) shifts of the old rows: those they shared already, device and markers since, what has drifted since."""
    old = new.fitted
    around = old.geodesic.with_nominal(FlangePoints(nominal, nominal.geometry.tool, same=True))
    places = old.measured() if old.slopes is None else old.fitted_points
    moved = place_slopes(around, around.linearise(old.x), places, new.centre) * new.deviations
    at = old.geodesic.linearise(None if old.data is None else old.x) if drifts else None
    if old.slopes is not None:
        moved, at = old.slopes @ moved, None if at is None else at.projected(old.slopes)
    drifted = [] if at is None else [columns(at) for columns in drifts]
    return torch.cat([old.noise.shared, moved[..., new.free], *drifted], 2)


def _sessions(tool: Tensor, new: NewRows, newest: GeometryMap) -> SessionMarkers:
    """k0 at the controls: every session with its own markers, every row with its own payload."""
    by_row, x = new.fitted.geodesic.spec.at_controls, new.fitted.deformation.x
    session, tools = torch.zeros(len(x), dtype=torch.int64, device=x.device), tool[None]
    if isinstance(by_row, SessionMarkers):
        session, tools, by_row = by_row.session, by_row.tools, by_row.nominal
    latest = torch.full((len(new.q),), len(tools), dtype=torch.int64, device=x.device)
    if isinstance(by_row, GeometryMap):
        newest = newest.under(joined_masses(by_row.payload, new.points.fitted.payload))
    return SessionMarkers(newest, torch.cat([session, latest]), torch.cat([tools, newest.geometry.tool[None]]))
