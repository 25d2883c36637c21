"""Find base and markers of a robot from measured points, or ball and sockets from joint values, without a start value.

Base and markers: :mod:`diffeo_calib.robots.placement`, of the rows that are no gross outliers. In all rows of socket s
the ball c, carried by the tip's poses (R_i, t_i), is at one point, so that

    (R_i - mean_s R) c + (t_i - mean_s t) = 0,    p_s = mean_s (R_i c + t_i),

linear in the ball c and then in the sockets p_s. Rows are weighed by their distance in units of the median.

Joint offsets of tens of degrees (an encoder mounted at another angle, a homing switch moved, a robot not mastered) are
excluded by the prior of a geometric calibration, whose errors are milliradians: they are found before it, with base and
markers, by robust least squares.
"""

from __future__ import annotations

import math
from dataclasses import replace
from math import sqrt
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import (
    PRECISE,
    Identification,
    KindRows,
    Rows,
    described,
    identify,
    solve,
)
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import MeasurementError, few, sentence, warn_user
from diffeo_calib.common.quantiles import known, largest_known
from diffeo_calib.measurements.checks import seen_markers
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.cartesian import turns_nowhere
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import UNDETERMINED_MOTION_M, place
from diffeo_calib.robots.se3 import transforms
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import marker_tips
from diffeo_calib.sensors.devices import median_weights


def register(robot: Tree | Geometry, q: Tensor, points: Tensor, on: tuple[str, ...] = ()) -> Identification:
    """Find the base and the markers of a robot in the frame of the measuring device, joint errors untouched.

    Args:
        robot: a chain, or a geometry whose joint errors are kept (its base and markers are not used).
        q: (N, n) joint values [rad or m]. points: (N, P, 3) measured markers [m]; NaN where they are hidden.
        on: names of their tips, P of them; the robot's first tip by default.

    Raises:
        MeasurementError: fewer measured coordinates than unknowns (6 + 3 P), or a marker that no row shows.
    """
    geometry = registered_geometry(robot, q, points, on)
    q, points = q.detach().cpu(), points.detach().cpu()
    squares = (geometry.points(q) - points)[seen_markers(points)].square()
    noise = sqrt(float(squares.sum()) / max(squares.numel() - 6 - 3 * points.shape[1], 1))
    return described(Rows(geometry, (KindRows.positions(q, points),)), [noise])


def registered_geometry(robot: Tree | Geometry, q: Tensor, points: Tensor, on: tuple[str, ...] = ()) -> Geometry:
    """Base and markers as of :func:`register`, without how well they are known, which takes as long as to find them."""
    chain = robot.chain if isinstance(robot, Geometry) else robot
    q, points = q.detach().cpu(), points.detach().cpu()
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
    placed = place(bare.marker_poses(q), points)
    base, tool = placed.base, placed.tool
    if turns_nowhere(chain):  # where the marker sits, or the middle of several, belongs to the base
        middle = tool.mean(0)
        base, tool = base @ transforms(torch.eye(3, dtype=tool.dtype, device=tool.device), middle), tool - middle
    return replace(bare, base=base, tool=tool)


def can_register(points: Tensor) -> bool:
    """Whether points (N, P, 3), NaN where hidden, are as many as the unknowns of a registration, every marker seen."""
    enough = len(known(points)) >= 6 + 3 * points.shape[1]
    return enough and bool(seen_markers(points).any(0).all())


ROUNDS = 30  # most rounds of weighing rows
SETTLED = 1e-6  # largest change of a weight at which these rounds end
HALF_WEIGHT_MEDIANS = 2.0  # distance, in medians, at which a row has half its weight


class SocketRegistration(NamedTuple):
    """Ball and sockets of a robot without errors."""

    geometry: Geometry  # with the ball as its marker; where the base is not known, it is the measuring frame
    positions: Tensor  # (S, 3) the sockets in the measuring frame, m
    distances: Tensor  # (N,) from the ball to its socket, m
    turning: float  # largest RMS motion of the ball's place by turns of the tool in the sockets, per unit of its offset


def register_sockets(bare: Geometry, q: Tensor, socket: Tensor) -> SocketRegistration:
    """Find ball and sockets, joint errors untouched.

    Args:
        bare: whose base and joint errors are kept: places are in its measuring frame. The ball is on the tip of the
            first marker. q: (N, n) joint values, rad or m. socket: (N,) number of the socket of each row.
    """
    bare = bare.with_tool(bare.tool[:1], bare.on[:1])
    poses = bare.marker_poses(q)[:, 0]
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    weights = torch.ones_like(t[:, 0])
    for _ in range(ROUNDS):
        A = R - _means(R, socket, weights)[socket]
        b = t - _means(t, socket, weights)[socket]
        root = weights.sqrt()
        U, s, Vt = torch.linalg.svd((root[:, None, None] * A).flatten(0, 1), full_matrices=False)
        kept = s > UNDETERMINED_MOTION_M * (3 * len(A)) ** 0.5  # directions that the rows leave open stay at the tip
        ball = Vt[kept].mT @ ((U[:, kept].mT @ -(root[:, None] * b).flatten()) / s[kept])
        distances = (A @ ball + b).norm(dim=1)
        before, weights = weights, median_weights(distances, HALF_WEIGHT_MEDIANS)
        if float((weights - before).abs().max()) < SETTLED:
            break
    return SocketRegistration(
        bare.with_tool(ball[None]), _means(R @ ball + t, socket, weights), distances, float(s[0]) / len(A) ** 0.5
    )


def socket_means(points: Tensor, socket: Tensor) -> Tensor:
    """The middle (S, 3) of points (N, 3) in each socket; rows far from it hardly count; NaN without rows."""
    weights = torch.ones_like(points[:, 0])
    for _ in range(ROUNDS):
        means = _means(points, socket, weights)
        weights = median_weights((points - means[socket]).norm(dim=1), HALF_WEIGHT_MEDIANS)
    return means


def _means(values: Tensor, socket: Tensor, weights: Tensor) -> Tensor:
    """Weighted means of values (N, ...) of each socket: (S, ...)."""
    count = int(socket.max()) + 1
    shape = (-1, *[1] * (values.ndim - 1))
    total = values.new_zeros(count, *values.shape[1:]).index_add(0, socket, values * weights.view(shape))
    return total / weights.new_zeros(count).index_add(0, socket, weights).view(shape)


OFFSET_STD, FREE_STD = 0.5, 10.0
"""Prior standard deviations, rad or m: of a joint offset, which only chooses among offsets that poses cannot separate,
and of base and markers beside them, no constraint."""
INLIER_ERROR = 0.1  # error of a coordinate, relative to the median distance, beyond which Huber's loss grows linearly
MAX_EVALUATIONS = 100


def find_joint_offsets(
    geometry: Geometry, q: Tensor, points: Tensor, deviation: float = OFFSET_STD, noise: float | None = None
) -> Tensor:
    """Offsets to add to the joint values so that base and markers explain the points best, by least squares.

    Args:
        geometry: a registered robot. q: (N, n) joint values [rad or m]. points: (N, P, 3) [m]; NaN where hidden.
        deviation: of the offsets' prior [rad or m]. noise: of a coordinate [m]; by default it is not known, and a few
            gross outliers have little influence.

    Returns:
        (n,) [rad or m]; zero where base or markers could explain the same change.
    """
    options: dict[str, Any] = PRECISE
    if noise is None:  # Huber's loss on every coordinate
        noise = float((geometry.points(q) - points).norm(dim=-1).nanmedian())
        options = {"loss": "huber", "f_scale": INLIER_ERROR, "x_scale": "jac", "max_nfev": MAX_EVALUATIONS}
    twists, parts = offset_twists(geometry), geometry.slices
    places = torch.eye(geometry.size, dtype=twists.dtype, device=twists.device)
    root = torch.cat([deviation * twists, FREE_STD * places[:, parts["base"]], FREE_STD * places[:, parts["tool"]]], 1)
    rows = Rows(geometry, (KindRows.positions(q, points),))
    fit = solve(rows, points.new_full((points[..., 0].numel(),), noise), root, **options)
    return (twists.mT @ fit.theta) / twists.square().sum(0)


def offset_twists(geometry: Geometry) -> Tensor:
    """(K, n) the errors of joints that are offsets of the n joint values, of mimic joints included."""
    chain = geometry.chain
    turning, coupling = chain.revolute[:, None], chain.coupling.to(geometry.base)
    axes = torch.cat([torch.where(turning, 0.0, chain.axes), torch.where(turning, chain.axes, 0.0)], 1)  # (n_all, 6)
    twists = coupling.new_zeros(geometry.size, chain.n)
    twists[geometry.slices["joints"]] = (axes[:, :, None] * coupling[:, None]).flatten(0, 1)
    return twists


def with_joint_offsets(geometry: Geometry, offsets: Tensor) -> Geometry:
    """The geometry with other joint offsets (n,): its points at q are those of the given geometry at q + offsets."""
    return geometry.absorb(offset_twists(geometry) @ offsets)


GROSS_DISTANCES, GROSS_ROUNDS = 10.0, 5
"""Median distances from which a row is a gross outlier and does not take part, and most registrations of the others."""
DRAWS, SURPLUS = 50, 2
"""Registrations of random rows that are tried if there may be many gross outliers, and their size as a multiple of the
rows that are needed: with 30 % outliers all of six rows are inliers with probability 0.12."""
CONSISTENT = 0.02  # residual, a median distance relative to the spread of the markers, with which rows need no draws
EXAMINED, ACCEPTED, REMAINING = 0.01, 0.02, 0.3
"""Such residuals from which joint offsets are estimated and that may remain with them, and which part may remain."""
LARGEST_OFFSET_RAD, WORSE = 0.8, 1.1
"""Largest offset of a turning joint that is accepted, and largest noise of a geometric calibration with offsets in that
of one without."""
REPORTED = 0.2  # smallest offset that is reported, as a part of the largest


def register_inliers(robot: Tree, data: Measurements) -> tuple[Identification, Tensor]:
    """Base and markers from the rows that are no gross outliers, and a first guess (N,) of these rows."""
    on = marker_tips(robot, data)
    inliers = _inliers(robot, data, on)
    return _registered_by(robot, data, inliers, on), inliers


def distances(geometry: Geometry, data: Measurements) -> Tensor:
    """From predicted to measured markers, (N, P) in m; NaN where they are hidden."""
    return (geometry.points(data.q) - data.points).norm(dim=-1)


def largest_distances(geometry: Geometry, data: Measurements) -> Tensor:
    """The largest distance of each row from predicted to measured markers, (N,) in m."""
    return largest_known(distances(geometry, data))


def spread(points: Tensor) -> float:
    """Root mean square distance of the markers from their centre without gross outliers and hidden markers, m."""
    squares = (points - points.nanmedian(dim=0, keepdim=True).values).square().sum(-1)
    return float(squares[squares <= GROSS_DISTANCES**2 * squares.nanmedian()].mean().sqrt())


def _registered_by(robot: Tree | Geometry, data: Measurements, inliers: Tensor, on: tuple[str, ...]) -> Identification:
    """Registration without gross outliers, from a first guess (N,) of the inliers; ``on``: tips of the markers."""
    for _ in range(GROSS_ROUNDS):
        registration = register(robot, data.q[inliers], data.points[inliers], on)
        largest = largest_distances(registration.geometry, data)
        near = largest <= GROSS_DISTANCES * float(largest.median())
        few_rows = int(near.sum()) < 0.5 * len(data) or not can_register(data.points[near])
        if bool((near == inliers).all()) or few_rows:
            break
        inliers = near
    return registration


def with_large_offsets(data: Measurements, registration: Identification, inliers: Tensor) -> Identification:
    """The registration, with joint offsets if these explain far more; then with a warning."""
    geometry, before = registration.geometry, float(distances(registration.geometry, data).nanmedian())
    chain, size = geometry.chain, spread(data.points)
    if before <= EXAMINED * size or len(data) < 2 * (2 + chain.n):
        return registration
    offsets = find_joint_offsets(geometry, data.q[inliers], data.points[inliers])
    again = _registered_by(with_joint_offsets(geometry, offsets), data, inliers, geometry.on)
    after = float(distances(again.geometry, data).nanmedian())
    explained = after <= min(REMAINING * before, ACCEPTED * size)
    turned = offsets[torch.tensor(chain.periodic, dtype=torch.bool, device=offsets.device)]
    if not explained or bool((turned.abs() > LARGEST_OFFSET_RAD).any()):
        return registration
    plain, other = (identify(start, data.q[inliers], data.points[inliers]) for start in (geometry, again.geometry))
    if other.noise > WORSE * plain.noise:
        return registration
    named = zip(chain.joint_names, offsets.tolist(), chain.periodic, strict=True)
    each = [
        f"{name} by {math.degrees(offset):.1f} degrees" if turns else f"{name} by {1e3 * offset:.1f} mm"
        for name, offset, turns in named
        if abs(offset) >= REPORTED * float(offsets.abs().max())
    ]
    what = f"joint offsets are far from the robot's description: {', '.join(each)}"
    got = f"residuals of {1e3 * before:.3g} mm, and of {1e3 * after:.3g} mm with these offsets added to the joints"
    fix = "the calibration starts from these offsets; check those in the description, and the order of the joints"
    warn_user(sentence(what, got=got, fix=fix))
    return again


def _inliers(robot: Tree, data: Measurements, on: tuple[str, ...]) -> Tensor:
    """Rows (N,) boolean that are near the best of a few registrations, of all rows and of random subsets.

    A least-squares fit of all rows is drawn towards gross outliers if there are many; a few random rows may be free
    of them. With the inliers every marker is seen.
    """

    def away(rows: Any) -> Tensor:
        return largest_distances(registered_geometry(robot, data.q[rows], data.points[rows], on), data)

    start = best = away(slice(None))
    every, gross = torch.ones_like(start, dtype=torch.bool), GROSS_DISTANCES
    if float(start.max()) <= gross * float(start.median()) <= gross * CONSISTENT * spread(data.points):
        return every
    share, generator = float(data.visible.double().mean()), seeded(0)
    drawn = SURPLUS * math.ceil((2.0 / data.markers + 1.0) / share)  # 6 + 3 P unknowns, 3 P coordinates
    for _ in range(DRAWS if len(data) > 2 * drawn else 0):
        rows = torch.randperm(len(data), generator=generator, device=HOST)[:drawn]
        if can_register(data.points[rows]):
            best = min(best, away(rows), key=lambda each: float(each.median()))
    near = best <= gross * float(best.median())
    better = float(best.median()) <= 0.5 * float(start.median())
    return near if better and can_register(data.points[near]) else every
