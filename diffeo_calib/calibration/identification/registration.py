"""Find the base of a robot and the markers on its tool from measured points, without a start value."""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import (
    LIMITS,
    Identification,
    Prior,
    checked_rows,
    in_mm,
    rms_distance,
)
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.common.hidden_values import known
from diffeo_calib.measurements.checks import seen_markers
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import MAX_ITERATIONS, TOOL_DEVIATION_M, UNDETERMINED_MOTION_M, place
from diffeo_calib.robots.tree import Tree

BASE_DEVIATION_M, BASE_DEVIATION_RAD = 5.0, 2.0
"""Standard deviations of a base about which the rows say nothing, around any place: a turn may be half of one."""


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
    slopes = geometry.sensitivities(q)[..., sought][seen_markers(points)].flatten(0, 1)  # (3 S, 6 + 3 P)
    s = torch.linalg.svdvals(slopes)
    count, coordinates = len(slopes) // 3, len(slopes)  # S sightings of markers
    kept = s > UNDETERMINED_MOTION_M * sqrt(count)
    rank, rms = int(kept.sum()), rms_distance(geometry, q, points)
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
    deviations = slopes.new_full((slopes.shape[1],), sqrt(markers) * TOOL_DEVIATION_M)
    deviations[:3], deviations[3:6] = BASE_DEVIATION_M, BASE_DEVIATION_RAD
    white = slopes * deviations / error
    eye = torch.eye(len(deviations), dtype=slopes.dtype, device=slopes.device)
    return deviations[:, None] * torch.linalg.inv(eye + white.mT @ white) * deviations
