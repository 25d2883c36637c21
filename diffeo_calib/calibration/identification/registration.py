"""Find base and markers of a robot from measured points, or ball and sockets from joint values, without a start value.

The base and the markers: :mod:`diffeo_calib.robots.placement`. Ball and sockets are found in closed form. In all rows
of socket s the ball c, carried by the tip's poses (R_i, t_i), is at one point, so that

    (R_i - mean_s R) c + (t_i - mean_s t) = 0,    p_s = mean_s (R_i c + t_i),

linear in the ball c and then in the sockets p_s. Rows are weighed by their distance in units of the median, so that
rows in a wrong socket lose their influence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import (
    LIMITS,
    Identification,
    Prior,
    checked_rows,
    in_mm,
)
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.common.hidden_values import known
from diffeo_calib.measurements.checks import seen_markers
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.place_priors import PLACES
from diffeo_calib.robots.placement import MAX_ITERATIONS, UNDETERMINED_MOTION_M, place
from diffeo_calib.robots.tree import Tree


def register(robot: Tree | Geometry, q: Tensor, points: Tensor, on: tuple[str, ...] = ()) -> Identification:
    """Find the base and the markers of a robot in the frame of the measuring device, joint errors untouched.

    Minimises sum |B (R_i c_k + t_i) - y_ik|^2 over the base B and the markers c_k, (R_i, t_i) their tip's poses, with a
    prior that keeps undetermined markers near the tip. No start is needed, see :mod:`diffeo_calib.robots.placement`.

    Args:
        robot: a chain, or a geometry whose joint errors are kept (its base and markers are not used).
        q: (N, n) joint values [rad or m].
        points: (N, P, 3) measured markers [m]; NaN where they are hidden.
        on: names of their tips, P of them; the robot's first tip by default.

    Raises:
        InputError: wrong shapes, or values that are not finite.
        MeasurementError: fewer measured coordinates than unknowns (6 + 3 P), a marker that no row shows, or numbers of
            rows that differ.
    """
    chain = robot.chain if isinstance(robot, Geometry) else robot
    q, points = checked_rows(chain, q, points)
    bare = Geometry.nominal(chain, points.shape[1], on)
    if isinstance(robot, Geometry):
        bare = replace(
            bare, joint_errors=robot.joint_errors, on=on or robot.on if robot.markers == bare.markers else on
        )
    unknowns, coordinates = 6 + 3 * bare.markers, len(known(points))
    if coordinates < unknowns:
        need = -(-unknowns // (3 * bare.markers))
        what = f"{unknowns} unknowns (base 6, markers {3 * bare.markers}) cannot be found"
        expected, got = f"at least {need} poses", f"{len(q)}, that is {coordinates} coordinates"
        raise MeasurementError.of(what, expected=expected, got=got, fix="measure more poses")
    if not bool(seen_markers(points).any(0).all()):
        never = few((~seen_markers(points)).all(0).nonzero()[:, 0].tolist())
        what, fix = f"{len(q)} rows never show marker {never}", "measure rows that show it, or leave it out"
        raise MeasurementError.of(what, expected="every marker in some rows", fix=fix)
    found = place(bare.marker_poses(q), points)
    return _registered(replace(bare, base=found.base, tool=found.tool), q, points, found.iterations)


def can_register(points: Tensor) -> bool:
    """Whether points (N, P, 3), NaN where hidden, are as many as the unknowns of a registration, every marker seen."""
    enough = len(known(points)) >= 6 + 3 * points.shape[1]
    return enough and bool(seen_markers(points).any(0).all())


def _registered(geometry: Geometry, q: Tensor, points: Tensor, iterations: int) -> Identification:
    """Residual, covariance and status of a registration."""
    parts = geometry.slices
    places = [*range(parts["base"].start, parts["base"].stop), *range(parts["tool"].start, parts["tool"].stop)]
    sought = torch.tensor(places, dtype=torch.int64, device=q.device)
    rms = float((geometry.points(q) - points).square().sum(-1).nanmean().sqrt())
    slopes = geometry.sensitivities(q)[..., sought][seen_markers(points)].flatten(0, 1)  # (3 S, 6 + 3 P)
    s = torch.linalg.svdvals(slopes)
    count, coordinates = len(slopes) // 3, len(slopes)  # S sightings of markers
    kept = s > UNDETERMINED_MOTION_M * sqrt(count)
    rank = int(kept.sum())
    noise = rms * sqrt(count / max(coordinates - rank, 1))
    covariance = torch.zeros(geometry.size, geometry.size, dtype=q.dtype, device=q.device)
    covariance[sought[:, None], sought] = _covariance(slopes, max(noise, LIMITS.smallest_noise_m) * sqrt(count))
    done = "converged" if iterations < MAX_ITERATIONS else "stopped before converging"
    status = f"{done} after {iterations} steps: {in_mm(rms, noise, 'estimated')}"
    if rank < len(sought):
        status += (
            f"; these poses leave {len(sought) - rank} of {len(sought)} directions of base and markers undetermined"
            " (chosen so that the markers are close to the tip): turn more joints, above all the wrist"
        )
    elif coordinates == rank:
        status += (
            "; there are only as many coordinates as unknowns, so other bases and markers may fit as well: measure "
            "more poses"
        )
    tails = Tails.none(len(q), geometry.markers, device=q.device)
    theta = torch.zeros(geometry.size, dtype=q.dtype, device=q.device)
    return Identification(geometry, rms, noise, covariance, iterations, status + ".", theta, Prior(), tails)


def _covariance(slopes: Tensor, error: float) -> Tensor:
    """Covariance (k, k) of base and markers, within their priors, for errors that are common to all rows.

    The errors of a nominal robot vary slowly with its configuration, so that many rows share them.

    Args:
        slopes: (3 S, k) derivatives by the twist of the base, then by the markers.
        error: of a coordinate, times the root of the number of points [m].
    """
    markers = (slopes.shape[1] - 6) / 3
    deviations = slopes.new_full((slopes.shape[1],), sqrt(markers) * PLACES.marker_m)
    deviations[:3], deviations[3:6] = PLACES.open_base_m, PLACES.open_base_rad
    white = slopes * deviations / error
    eye = torch.eye(len(deviations), dtype=slopes.dtype, device=slopes.device)
    return deviations[:, None] * torch.linalg.inv(eye + white.mT @ white) * deviations


ROUNDS = 30
"""Most rounds of weighing rows."""
SETTLED = 1e-6
"""Largest change of a weight at which these rounds end."""
MEDIANS = 2.0
"""Distance, in medians, at which a row has half its weight."""


@dataclass(frozen=True, eq=False)
class SocketRegistration:
    """Ball and sockets of a robot without errors.

    Args:
        identification: geometry with the ball as its marker; where the base is not known, it is the measuring frame.
        positions: (S, 3) the sockets in the measuring frame, m.
        distances: (N,) from the ball to its socket, m.
        tilt: (3,) root mean square motion of the ball's place, per unit of its offset from the tip, by turns of the
            tool in the sockets, along three principal directions, largest first: 0 where the tool never turns.
    """

    identification: Identification
    positions: Tensor
    distances: Tensor
    tilt: Tensor


def register_sockets(robot: Tree | Geometry, q: Tensor, socket: Tensor) -> SocketRegistration:
    """Find ball and sockets, joint errors untouched.

    Args:
        robot: n joints, with one tip; or a geometry, whose base and joint errors are kept: places are then in its
            measuring frame. q: (N, n) joint values, rad or m. socket: (N,) number of the socket of each row.
    """
    bare = robot.with_tool(robot.tool[:1], robot.on[:1]) if isinstance(robot, Geometry) else Geometry.nominal(robot, 1)
    poses = bare.marker_poses(q)[:, 0]
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    weights = torch.ones_like(t[:, 0])
    for _ in range(ROUNDS):
        A = R - _means(R, socket, weights)[socket]
        b = t - _means(t, socket, weights)[socket]
        root = weights.sqrt()
        ball = _determined_part((root[:, None, None] * A).flatten(0, 1), -(root[:, None] * b).flatten())
        distances = (A @ ball + b).norm(dim=1)
        before, weights = weights, median_weights(distances)
        if float((weights - before).abs().max()) < SETTLED:
            break
    seen = R @ ball + t
    tilt = torch.linalg.svdvals(A.flatten(0, 1)) / len(A) ** 0.5
    found = _identification(bare.with_tool(ball[None]), A, distances, int(weights.numel()))
    return SocketRegistration(found, _means(seen, socket, weights), distances, tilt)


def socket_means(points: Tensor, socket: Tensor) -> Tensor:
    """The middle (S, 3) of points (N, 3) in each socket; rows far from it hardly count; NaN without rows."""
    weights = torch.ones_like(points[:, 0])
    for _ in range(ROUNDS):
        means = _means(points, socket, weights)
        weights = median_weights((points - means[socket]).norm(dim=1))
    return means


def median_weights(distances: Tensor) -> Tensor:
    """Weights (N,) of rows by their distances (N,) in medians: 1 / (1 + (d / 2 medians)^2)."""
    scale = MEDIANS * distances.median().clamp(min=LIMITS.smallest_noise_m)
    return 1.0 / (1.0 + (distances / scale).square())


def _means(values: Tensor, socket: Tensor, weights: Tensor) -> Tensor:
    """Weighted means of values (N, ...) of each socket: (S, ...)."""
    count = int(socket.max()) + 1
    shape = (-1, *[1] * (values.ndim - 1))
    total = values.new_zeros(count, *values.shape[1:]).index_add(0, socket, values * weights.view(shape))
    return total / weights.new_zeros(count).index_add(0, socket, weights).view(shape)


def _determined_part(A: Tensor, b: Tensor) -> Tensor:
    """The smallest x that minimises |A x - b|: directions that the rows leave open stay at the tip."""
    U, s, Vt = torch.linalg.svd(A, full_matrices=False)
    kept = s > UNDETERMINED_MOTION_M * len(A) ** 0.5
    return Vt[kept].mT @ ((U[:, kept].mT @ b) / s[kept])


def _identification(geometry: Geometry, A: Tensor, distances: Tensor, rows: int) -> Identification:
    """The registration as other registrations are described. Errors of the robot do not average out over its rows."""
    rms = float(distances.square().mean().sqrt())
    median = float(distances.median())
    noise = max(median / sqrt(2.37), LIMITS.smallest_noise_m)
    white = A.flatten(0, 1) * PLACES.marker_m / (noise * sqrt(rows))
    eye = torch.eye(3, dtype=A.dtype, device=A.device)
    covariance = A.new_zeros(geometry.size, geometry.size)
    tool = geometry.slices["tool"]
    covariance[tool, tool] = PLACES.marker_m**2 * torch.linalg.inv(eye + white.mT @ white)
    status = f"spread within sockets {1e3 * rms:.4g} mm RMS, median {1e3 * median:.4g} mm."
    theta, tails = A.new_zeros(geometry.size), Tails.none(rows, 1, device=A.device)
    return Identification(geometry, rms, noise, covariance, 0, status, theta, Prior(), tails)
