"""Find where the measuring device stands and where the markers sit, from a few rows and a calibrated model.

With everything else kept, the rows y_i see the model through a small motion D(u) of the measuring frame and of the
markers, after a start in closed form (robots/placement.py):

    T^-1 y_i - k1(q_i; m) = S_i u + e_i + noise_i,    cov(e_i, e_j) = C(q_i, q_j),

C the posterior covariance of the fit, R that of the noise, V = C + R. With a prior N(mu, P) of u,

    u = mu + A (r - S mu),    A = ((P + B)^-1 + S^T R^-1 S)^-1 S^T R^-1,    U = (1 - A S) P (1 - A S)^T + A V A^T.

B is zero, or the covariance of the markers' old places by the fit, a part of C: where the fit hardly knew a marker, as
along the axis of a tool that was never tilted, the rows place it, though it stayed. Errors of rows left out choose
between the two. R in place of V in the weights costs 1 % where the model is right. Where the robot has changed since
its fit, errors are not correlated as C says, and weights by V do harm: on another series of a UR10 more rows hurt.
The covariance U, the test for outliers and the marginal likelihood take all of V.

The base may be anywhere. A marker either stayed where it was (within 0.01 mm), moved a little (1 mm), or is another one
(0.3 m); the marginal likelihood of the rows weighs the three, and their mean is taken. Where the rows cannot tell, the
deviations of all three remain in the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import nan
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.kinematics.re_registration.registered_map import marker_slopes
from diffeo_calib.kinematics.tool import TOOL_LEVER, tool_points, tool_transform
from diffeo_calib.maps.noise import measured_coordinates
from diffeo_calib.measurements.bodies import Body
from diffeo_calib.measurements.pose_frames import own_blocks
from diffeo_calib.measurements.poses import poses_from_marks
from diffeo_calib.regression.factor import Factor
from diffeo_calib.regression.regions import OTHER_DATE, region_scale
from diffeo_calib.robots.placement import PLACES, place, rigid_fit
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.sensors.set_ups import frame_slopes

MAX_STEPS = 100
SETTLED = 1e-9
"""The iteration ends with a step below this, m and rad."""
SETTLED_WEIGHT = 1e-6
SMALL_STEP = 1e-2
"""Below such a step of the markers, m and rad, C hardly changes, and the model's points follow to first order."""
FREEDOM = 4.0
"""Degrees of freedom nu of Student's t: errors of real robots have heavy tails, which few rows cannot average out."""


@dataclass(frozen=True, eq=False)
class Session:
    """Rows of a new set-up, seen by a fitted map in its own frame.

    Args:
        fitted: the map. nominal: its nominal map. same: whether the markers are those of the fit.
        q: (M, n). points: (M, P, 3) measured, m, NaN where hidden. noise: (M, 3 P, 3 P) m^2, without information there.
        centre: (3,) about which the frame turns, m.
        known: (6 + d, 6 + d) covariance of frame and body from an earlier registration; zero without one.
        by_fit: (6 + d, 6 + d) covariance of the body's old place by the fit, zero elsewhere; C includes it.
        shared: (M, 3 P, c) effects of errors of unit variance that rows share, m.
        frame_free, body_free: what may have moved.
        ball: whether the last point is a ball that no row shows: it stays where it was on the tool.
    """

    fitted: FittedMap
    nominal: GeometryMap
    same: bool
    q: Tensor
    points: Tensor
    noise: Tensor
    centre: Tensor
    known: Tensor
    by_fit: Tensor
    shared: Tensor
    frame_free: bool
    body_free: bool
    ball: bool = False

    def rows(self, keep: Tensor) -> Session:
        """The session with some of its rows."""
        own = {name: getattr(self, name)[keep] for name in ("q", "points", "noise", "shared")}
        return replace(self, nominal=self.nominal.rows(keep), **own)

    def free_unknowns(self, size: int) -> Tensor:
        """Which of the unknowns are free, those of the frame and ``size`` of the body: (6 + size,) boolean."""
        free = torch.ones(6 + size, dtype=torch.bool, device=self.q.device)
        free[:6], free[6:] = self.frame_free, self.body_free
        free[len(free) - 3 * self.ball :] = False
        return free

    def seen(self, T: Tensor) -> Tensor:
        """The measured points in the frame of the map, T^-1 y."""
        return (self.points - T[:3, 3]) @ T[:3, :3]

    def moved(self, T: Tensor, step: Tensor) -> Tensor:
        """T after a shift and a small turn about the centre."""
        turn = rotation(step[3:])
        return T @ transforms(turn, self.centre + step[:3] - turn @ self.centre)

    def view(self, body: Body, covariance: Tensor | None = None) -> View:
        """The model's points of a body at the rows; the covariance C is passed if it is known already."""
        points = FlangePoints(self.nominal, body.points, same=self.same)
        deformation = self.fitted.geodesic.with_nominal(points)
        value, at = deformation.linearised_value(self.q)
        slopes = marker_slopes(deformation, points, at) @ body.slopes
        C = self.fitted.covariance_between(at) if covariance is None else covariance
        return View(value.unflatten(1, (-1, 3)), slopes, C)

    def rows_at(self, T: Tensor, view: View, weights: Tensor) -> Rows:
        """Residuals, slopes and covariance of the rows, each of which has a weight (M,)."""
        slopes = torch.cat([frame_slopes(view.places, self.centre), view.slopes], -1)
        Z = self.shared.flatten(0, 1)
        V = view.covariance + torch.block_diag(*self.noise) + Z @ Z.mT
        kept = 1.0 - self.free_unknowns(slopes.shape[2] - 6).to(V)
        S = slopes.flatten(0, 1) * kept
        V = 0.5 * (V + V.mT) + S @ self.known @ S.mT
        V = V + torch.block_diag(*(row_blocks(V, len(weights)) * (doubt(weights) - 1.0)[:, None, None]))
        residual = (self.seen(T) - view.places).nan_to_num(0.0).flatten(1)  # any value would do where hidden
        return Rows(residual, slopes, V, self.noise / weights[:, None, None])


@dataclass(frozen=True, eq=False)
class View:
    """A body seen by the model: places (M, P, 3), slopes by its unknowns (M, 3 P, d), C (3 P M, 3 P M)."""

    places: Tensor
    slopes: Tensor
    covariance: Tensor

    def moved(self, step: Tensor) -> View:
        """The view after a small step (d,) of the body, to first order."""
        return replace(self, places=self.places + (self.slopes @ step).view(self.places.shape))

    def rows(self, keep: Tensor) -> View:
        """The view of some rows."""
        M, m, _ = self.slopes.shape
        C = self.covariance.view(M, m, M, m)[keep][:, :, keep].reshape(len(keep) * m, -1)
        return View(self.places[keep], self.slopes[keep], C)


@dataclass(frozen=True, eq=False)
class Rows:
    """A session linearised at one place: residual (M, m), slopes (M, m, k), V (M m, M m), R (M, m, m)."""

    residual: Tensor
    slopes: Tensor
    V: Tensor
    noise: Tensor

    @property
    def visible(self) -> Tensor:
        """(M, m) boolean: the coordinates that were measured."""
        return measured_coordinates(self.noise)


class Place(NamedTuple):
    """Where an estimate begins: the frame T (4, 4), the body, and its view."""

    session: Session
    T: Tensor
    body: Body
    view: View


@dataclass(frozen=True, eq=False)
class Estimate:
    """The best place under one prior, and what the rows say about it.

    Args:
        T: (4, 4). body: where the markers sit. rows: the session linearised there. weights: (M,) of the rows.
        free: (f,) numbers of the unknowns that are free. mean: (f,) mu. prior: (f, f) P.
        by_fit: (f, f) B.
    """

    T: Tensor
    body: Body
    rows: Rows
    weights: Tensor
    free: Tensor
    mean: Tensor
    prior: Tensor
    by_fit: Tensor

    @cached_property
    def target(self) -> Tensor:
        """(M m,) r - S mu."""
        return self.rows.residual.flatten() - self.rows.slopes.flatten(0, 1)[:, self.free] @ self.mean

    @cached_property
    def factor(self) -> Factor:
        """Of V + S P S^T."""
        S = self.rows.slopes.flatten(0, 1)[:, self.free]
        return Factor.of(self.rows.V, S @ torch.linalg.cholesky(self.prior))

    @cached_property
    def solved(self) -> Tensor:
        """(M m,) (V + S P S^T)^-1 (r - S mu)."""
        return self.factor.solve(self.target[:, None])[:, 0]

    @cached_property
    def blocks(self) -> Tensor:
        """The blocks of V (M, m, m), the covariance of each row."""
        return row_blocks(self.rows.V, len(self.weights))

    @cached_property
    def gain(self) -> Tensor:
        """A = ((P + B)^-1 + S^T R^-1 S)^-1 S^T R^-1 (f, M m)."""
        S = self.rows.slopes[..., self.free]
        weighted = torch.linalg.solve(self.rows.noise, S)  # (M, m, f)
        inverse = torch.linalg.inv(torch.linalg.inv(self.prior + self.by_fit) + (weighted.mT @ S).sum(0))
        return inverse @ weighted.flatten(0, 1).mT

    @cached_property
    def covariance(self) -> Tensor:
        """U (f, f)."""
        S = self.rows.slopes.flatten(0, 1)[:, self.free]
        missed = torch.eye(len(self.free), dtype=S.dtype, device=S.device) - self.gain @ S
        return missed @ self.prior @ missed.mT + self.gain @ self.rows.V @ self.gain.mT

    @property
    def step(self) -> Tensor:
        """u (f,)."""
        return self.mean + self.gain @ self.target

    @property
    def student_t_weights(self) -> Tensor:
        """(M,) weights of Student's t: (nu + m) / (nu + r^T V^-1 r) of each row's residual after the step."""
        m, own = self.rows.visible.sum(1), self.blocks / doubt(self.weights)[:, None, None]
        left = (self.rows.residual - self.rows.slopes[..., self.free] @ self.step)[..., None]
        return (FREEDOM + m) / (FREEDOM + (left.mT @ torch.linalg.solve(own, left))[:, 0, 0])

    @property
    def determined(self) -> float:
        """Number of unknowns that the rows determine, between 0 and f."""
        return len(self.free) - float(torch.cholesky_inverse(self.factor.B).trace())

    @property
    def quadratic(self) -> float:
        """(r - S mu)^T (V + S P S^T)^-1 (r - S mu)."""
        return float(self.target @ self.solved)

    @property
    def log_evidence(self) -> float:
        """log N(r; S mu, V + S P S^T)."""
        return self.factor.log_density(self.target, self.solved)

    @cached_property
    def alone(self) -> Tensor:
        """(M, m, m) what makes the residual of each row one from the place that the others give."""
        S = self.rows.slopes[..., self.free]
        own = S @ self.gain.view(len(self.free), len(S), -1).movedim(1, 0)
        return torch.linalg.inv(torch.eye(own.shape[1], dtype=own.dtype, device=own.device) - own)

    @cached_property
    def left_out(self) -> Tensor:
        """(M, m) how far every row is from its prediction by the model as the other rows place it, m.

        NaN where markers are hidden.
        """
        left = self.rows.residual - self.rows.slopes[..., self.free] @ self.step
        errors = (self.alone @ left[..., None])[..., 0]
        return errors.masked_fill(~self.rows.visible, nan)

    @property
    def left_out_square(self) -> float:
        """Mean square of these, m^2; rows that fit badly count less."""
        squares = self.left_out.square().nanmean(1)
        weights = self.weights.clamp(max=1.0)
        return float((weights * squares).nansum() / weights.sum())

    @cached_property
    def inflation(self) -> float:
        """Factor on all variances, one or more, with which 95 % regions hold the rows as placed by all others.

        The errors that :attr:`left_out` has are linear in those of model and rows, so that their covariance is exact.
        """
        flat, (M, m) = self.rows.slopes.flatten(0, 1)[:, self.free], self.rows.residual.shape
        to_error = torch.eye(M * m, dtype=flat.dtype, device=flat.device) - flat @ self.gain
        to_error = (self.alone @ to_error.view(M, m, -1)).flatten(0, 1)
        whole = to_error @ (self.rows.V + flat @ self.prior @ flat.mT) @ to_error.mT
        usual = self.blocks / doubt(self.weights)[:, None, None]  # a new row is not doubted
        covariance = row_blocks(whole, M) - self.blocks + usual
        markers, errors = m // 3, self.left_out.unflatten(1, (-1, 3))
        away = errors.nan_to_num(0.0)[..., None]
        squares = (away.mT @ torch.linalg.solve(own_blocks(covariance, markers), away))[..., 0, 0]
        squares = squares.masked_fill(errors.isnan().any(2), nan)
        return max(1.0, region_scale(squares, 3, torch.full_like(squares, 1.0 / markers), OTHER_DATE))


def doubt(weights: Tensor) -> Tensor:
    """Factors (M,), one or more, by which rows of these weights vary more than model and noise lead to expect.

    A row that fits well has a weight above one, and is no better known for that. What a row varies more is its own, so
    that errors of the model which rows share keep their covariance C: with less of them the covariance of a prediction
    would not be positive.
    """
    return (1.0 / weights).clamp(min=1.0)


def row_blocks(V: Tensor, rows: int) -> Tensor:
    """The blocks (M, m, m) of a matrix (M m, M m) on its diagonal."""
    each = torch.arange(rows, device=V.device)
    return V.view(rows, -1, rows, len(V) // rows)[each, :, each]


def estimate(start: Place, metres: float, weights: Tensor | None = None) -> Estimate:
    """The better one of :func:`_estimate` with B and without, by errors of rows left out.

    Args:
        start: where to begin. metres: prior deviation of the markers from their old places, m.
        weights: (M,) of the rows; by default those of Student's t, by iteration.
    """
    found, by_fit = _estimate(start, metres, weights), start.session.by_fit
    known_well = max(metres**2, float(start.session.fitted.new_noise.diagonal().mean()))
    if float(by_fit.diagonal().max()) <= known_well or not start.session.body_free:
        return found
    held = replace(start.session, by_fit=torch.zeros_like(by_fit))
    return min(found, _estimate(start._replace(session=held), metres, weights), key=lambda each: each.left_out_square)


def _estimate(start: Place, metres: float, weights: Tensor | None) -> Estimate:
    """Gauss-Newton from a start; arguments as above."""
    session, T, body, view = start
    free = session.free_unknowns(len(body.from_old)).nonzero()[:, 0]
    deviations = torch.cat([torch.full_like(T[0, :3], PLACES.sought_base_m_rad).repeat(2), body.deviations(metres)])
    prior = (session.known + torch.diag(deviations.square()))[free[:, None], free]
    given = torch.ones_like(session.q[:, 0]) if weights is None else weights
    exact = True
    for _ in range(MAX_STEPS):
        mean = torch.cat([torch.zeros_like(deviations[:6]), -body.from_old])[free]
        rows = session.rows_at(T, view, given)
        found = Estimate(T, body, rows, given, free, mean, prior, session.by_fit[free[:, None], free])
        step = torch.zeros_like(deviations).index_copy(0, free, found.step)
        again = given if weights is not None else found.student_t_weights
        if float(step.abs().max()) < SETTLED and float((again - given).abs().max()) < SETTLED_WEIGHT:
            if exact:
                break
            view, exact = session.view(body, view.covariance), True
            continue
        T, body, given = session.moved(T, step[:6]), body.stepped(step[6:]), again
        largest = float(step[6:].abs().max())
        if largest > SMALL_STEP:
            view, exact = session.view(body), True
        elif largest > 0:
            view, exact = view.moved(step[6:]), False
    return found


def at_old_places(session: Session, body: Body, view: View) -> Place:
    """A start with the markers where they were, the frame in closed form."""
    T = torch.eye(4, dtype=session.q.dtype, device=session.q.device)
    if session.frame_free:
        T = rigid_fit(view.places.flatten(0, 1), session.points.flatten(0, 1))
    return Place(session, T, body, view)


def anywhere(session: Session, body: Body) -> Place:
    """A start with frame and markers in closed form."""
    own = session.nominal.geometry
    tips = list(dict.fromkeys(own.on)) if len(own.on) == session.points.shape[1] else [own.on[0]]
    corners = tool_points(tool_transform(None).to(session.q.device)).repeat(len(tips), 1)
    points = FlangePoints(session.nominal, corners, on=tuple(tip for tip in tips for _ in range(3)))
    marks = session.fitted.geodesic.with_nominal(points)(session.q).view(-1, 3, 3)
    poses = poses_from_marks(marks, TOOL_LEVER).view(-1, len(tips), 4, 4)
    carrying = [tips.index(tip) for tip in own.on] if len(tips) > 1 else [0] * session.points.shape[1]
    found = place(poses[:, carrying], session.points)
    seen = len(found.tool) - session.ball
    placed = body.at(torch.cat([found.tool[:seen], body.old[seen:]]))
    return Place(session, found.base, placed, session.view(placed))
