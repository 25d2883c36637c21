"""A model in a new place: the record of a registration, and the map whose predictions include its uncertainty.

The registered model is T o k1(.; m), with a transform T of the measuring frame and markers m on the flange that were
estimated from a few rows. Their error u (shift and turn of the frame, then shifts of the markers) follows from the
errors e of the model at these rows and from their noise, u = u' - A (e + noise), so that the error of a prediction is

    e(q) + S u,    covariance  C(q, q) + S U S^T - S A C(rows, q) - (S A C(rows, q))^T,

with S the derivatives by u, U the covariance of u, and C the posterior covariance of the fit. The last terms matter: a
base that the fit left uncertain is found anew together with the frame.

T o k1 is as exact as k1. If the task kernel is the same in all directions, K_W(R y, R y') = K_W(y, y'), rotating points
and momenta of a geodesic rotates the geodesic. So T o psi o k0 is the map with

    base <- T base,    p <- R p,    noise <- R noise R^T,

R the rotation of T. The controls z0 = k0(xi) follow the base, and theta stays: its error twist stands behind the base.

Sentences name what rows hardly determine: the measuring frame is judged with the markers given, since where both move
together, the marker is what is not known, and turning the tool determines it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import degrees
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import NEGLIGIBLE_TURN_RAD, FittedMap
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.measurements.poses import POINTS, own_blocks
from diffeo_calib.regression.conditional import Conditional, Estimated
from diffeo_calib.robots.se3 import nearest_rotations, transforms
from diffeo_calib.sensors.set_ups import frame_slopes

LARGE_EXCESS = 3.0  # residuals by this factor above the expected ones mean that something else has changed too
EXCHANGED_SHARE = 0.1  # distance to another marker's old place, relative to that from its own, of exchanged ones


@dataclass(frozen=True, eq=False)
class Registration:
    """Result of a registration, and the rows behind it.

    Args:
        transform: (4, 4) from the measuring frame before to the new one, m.
        markers: (P, 3) markers, or the three points of a measured frame, in the tip's frame as the model has it, m.
            Where that frame is on the real flange only the prior of the fit knows; it cancels in predictions.
        lever: distance of the three points from the origin of a measured frame, m; None for markers.
        same: whether these are the markers of the fit, one for one, moved or not.
        shift: (P, 3) how far the markers moved on the flange, m; None if there were others before.
        covariance: (6 + 3 P, 6 + 3 P) of the errors of shift [m] and turn [rad] of the measuring frame about
            ``centre``, along its axes, then of the markers [m].
        centre: (3,) in the new measuring frame, m.
        q: (M, n) configurations that took part. gain: (6 + 3 P, 3 P M) A, see above.
        noise: (3 P, 3 P) covariance of a new measurement, m^2.
        free: what could have moved: "both", "base" or "marker".
        outliers: numbers of the rows that did not take part, see :attr:`Measurements.line_numbers`.
        rms_before: RMS distance of the rows from the model before, m; None if it had other markers.
        rms_after: the same after registration to these rows. left_out_rms: the same, each row predicted by the others.
        excess: residuals in units of what model and noise lead to expect, outliers left out; about 1.
        same_place: probability that the markers stayed where they were; None if that was not asked.
        undetermined: sentences about directions that the rows hardly determine.
        table_sha256: of the tables from which the model learnt, see :attr:`Measurements.sha256`, with spaces between.
    """

    transform: Tensor
    markers: Tensor
    lever: float | None
    same: bool
    shift: Tensor | None
    covariance: Tensor
    centre: Tensor
    q: Tensor
    gain: Tensor
    noise: Tensor
    free: str
    outliers: tuple[int, ...]
    rms_before: float | None
    rms_after: float
    left_out_rms: float
    excess: float
    same_place: float | None
    undetermined: tuple[str, ...]
    table_sha256: str = ""

    @property
    def exchanged(self) -> tuple[int, ...]:
        """Numbers of the markers, or of a frame's points, that are where other ones were."""
        if self.shift is None or not self.same:
            return ()
        old, size = self.markers - self.shift, self.shift.norm(dim=1)
        away, where = torch.cdist(self.markers, old).min(1)
        numbers = torch.arange(len(old), device=where.device)
        moved = (where != numbers) & (away < EXCHANGED_SHARE * size)
        moved = moved & moved[where]
        return tuple(numbers[moved].tolist()) if sorted(where[moved].tolist()) == numbers[moved].tolist() else ()

    @property
    def rows(self) -> int:
        """Number of configurations that took part."""
        return len(self.q)

    @property
    def doubtful(self) -> bool:
        """Whether errors remain that only a change of the robot or wrong rows explain: it is in the places, too."""
        return self.excess > LARGE_EXCESS

    @property
    def frame_deviations(self) -> Tensor:
        """(6,) standard deviations of shift [m] and turn [rad] of the measuring frame about ``centre``."""
        return self.covariance.diagonal()[:6].clamp(min=0).sqrt()

    @property
    def marker_deviations(self) -> Tensor:
        """(P, 3) standard deviations of the markers in the tip's frame, m."""
        return self.covariance.diagonal()[6:].clamp(min=0).sqrt().unflatten(0, (-1, 3))

    @property
    def known_m(self) -> float:
        """Standard deviation of the markers in the direction in which the rows show them least, m."""
        blocks = self.covariance[6:, 6:].unflatten(0, (-1, 3)).unflatten(2, (-1, 3)).diagonal(dim1=0, dim2=2)
        return float(torch.linalg.eigvalsh(blocks.movedim(-1, 0)).max().clamp(min=0).sqrt())


class RegisteredMap(FittedMap):
    """T o k1 of the markers of a registration.

    Args:
        fitted: the fitted map, seen from the new measuring frame (:func:`moved`).
        registration: what was found.

    Raises:
        InputError: the fitted map is not that of a robot.
    """

    def __init__(self, fitted: FittedMap, registration: Registration) -> None:
        self.fitted, self.registration = fitted, registration
        self.points = FlangePoints(robot_map(fitted), registration.markers, same=registration.same)
        noise = registration.noise.to(fitted.deformation.x.device)
        super().__init__(fitted.geodesic.with_nominal(self.points), fitted.noise, fitted.data, noise)
        self.at_registration = self.geodesic

    def with_nominal(self, nominal: NominalMap) -> RegisteredMap:
        """Return the map around another nominal map of the fit."""
        other = RegisteredMap(self.fitted.with_nominal(nominal), self.registration)
        other.at_registration = self.at_registration
        return other

    @property
    def unregistered(self) -> FittedMap:
        """The map of the fit."""
        return self.fitted

    def to(self, device: torch.device | str) -> RegisteredMap:
        """Return the map on a device, where its inputs must be too."""
        return RegisteredMap(self.fitted.to(device), self.registration)

    def linearised_value(
        self, x: Tensor, geodesic: GeodesicDeformation | None = None, held: slice = slice(0)
    ) -> tuple[Tensor, Linearisation]:
        """With columns by frame and markers of the registration, which are held on other points of the body."""
        around, record = geodesic or self.geodesic, self.registration
        points, at = super().linearised_value(x, around, held)
        nominal: Any = around.spec.nominal
        if nominal.points is record.markers:
            columns = place_slopes(around, at, points, record.centre.to(points))
        else:
            columns = frame_slopes(points.unflatten(1, (-1, 3)), record.centre.to(points))
        return points, at.with_columns(columns, self.fitted.columns)

    @property
    def _turn_variance(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """With that of the frame, where its rows leave a turn of many degrees undetermined."""
        variance = float(self.registration.covariance.diagonal()[3:6].sum())
        return self.fitted._turn_variance + variance * (variance > NEGLIGIBLE_TURN_RAD**2)

    @cached_property
    def conditional(self) -> Conditional:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The conditional of the fit, with what the registration found from it."""
        record, first, x = self.registration, self.fitted.columns, self.deformation.x
        at = self.at_registration.linearise(record.q.to(x))
        gain, columns = (record.gain.to(x), range(first, first + len(record.covariance))), record.covariance.to(x)
        return Estimated(self.fitted.conditional, at, *gain, columns)


def marker_slopes(deformation: GeodesicDeformation, points: FlangePoints, at: Linearisation) -> Tensor:
    """Derivatives of k1 by shifts of its own points in the tip's frame, Dpsi R_tip: (N, 3 P, 3 P)."""
    shifts = points.shifts(at.xi, deformation.momenta.theta)  # (N, 3 P, 3 P)
    by_points = at.task[0].effect  # Dpsi (N P, 3, 3)
    return (by_points @ shifts.view(len(by_points), 3, -1)).view(shifts.shape)


def place_slopes(deformation: GeodesicDeformation, at: Linearisation, places: Tensor, centre: Tensor) -> Tensor:
    """Derivatives (N, 3 P, 6 + 3 P) of points by shift and turn of the device's frame and by the markers' places.

    Args:
        deformation: k1 around :class:`FlangePoints`. at: its linearisation at N configurations.
        places: (N, 3 P) points there, m. centre: (3,) about which the frame turns, m.
    """
    points: Any = deformation.spec.nominal
    by_frame = frame_slopes(places.unflatten(1, (-1, 3)), centre)
    return torch.cat([by_frame, marker_slopes(deformation, points, at)], -1)


def robot_map(fitted: FittedMap) -> GeometryMap:
    """The nominal map of a robot's fitted map; InputError for another map."""
    nominal = fitted.deformation.spec.nominal
    if not isinstance(nominal, GeometryMap):
        raise InputError.of("the map of a robot model", expected="a GeometryMap", got=type(nominal).__name__)
    return nominal


def fitted_markers(fitted: FittedMap) -> Tensor:
    """(P, 3) the markers of a robot's fitted map, in the frames of their tips, m."""
    geometry, theta = robot_map(fitted).geometry, fitted.deformation.momenta.theta
    return geometry.tool + theta[geometry.slices["tool"]].view(-1, 3)


def moved(fitted: FittedMap, T: Tensor) -> FittedMap:
    """T o k1.

    Args:
        fitted: k1. T: (4, 4) rigid transform from the old to the new measuring frame, m.

    Raises:
        InputError: the map is not exact, or its task kernel is not the same in all directions.
    """
    old, nominal = fitted.geodesic, robot_map(fitted)
    check_isotropic(old.spec.task_kernel)
    device, geometry = old.x.device, nominal.geometry
    base = T.to(geometry.base.device) @ geometry.base
    base = transforms(nearest_rotations(base[:3, :3]), base[:3, 3])
    after = nominal.with_geometry(replace(geometry, base=base))
    by_row: Any = old.spec.at_controls
    by_row = by_row if by_row is None else by_row.around(after)
    spec = replace(old.spec, nominal=after, at_controls=by_row)
    R = T[:3, :3].to(device)
    b, p, theta = old.momenta.tensors
    deformation = GeodesicDeformation(spec, old.x, Momenta(b, p @ R.mT, theta), old.integrator)
    changes = {"deformation": deformation, "new_noise": turned(fitted.new_noise, R)}
    if fitted.slopes is not None:  # what was measured has no direction of its own
        each = torch.block_diag(*[R] * (fitted.m // 3))
        return replace(fitted, slopes=fitted.slopes @ each.mT, **changes)
    noise = Noise(turned(fitted.noise.covariance, R), (R @ fitted.noise.shared.unflatten(1, (-1, 3))).flatten(1, 2))
    y = None if fitted.y is None else (fitted.y.unflatten(1, (-1, 3)) @ R.mT + T[:3, 3].to(device)).flatten(1)
    return replace(fitted, noise=noise, y=y, **changes)


def turned(covariance: Tensor, R: Tensor) -> Tensor:
    """The covariance of turned points: (..., 3 P, 3 P), (3, 3) -> (..., 3 P, 3 P), symmetric to the last bit."""
    each = torch.block_diag(*[R] * (covariance.shape[-1] // 3))
    after = each @ covariance @ each.mT
    return 0.5 * (after + after.mT)


def check_isotropic(kernel: Kernel) -> None:
    """Raise InputError unless a kernel on R^3 is the same in all directions."""
    for term in kernel.terms:
        same = False
        if isinstance(term, RadialKernel) and term.columns is None and term.output is None:
            periodic = [term.periodic] if isinstance(term.periodic, bool) else term.periodic
            scales = term.lengthscale, term.variance
            same = not any(periodic) and all(bool((scale == scale.flatten()[0]).all()) for scale in scales)
        if not same:
            what = f"the task kernel of this model ({term!r}) is not the same in all directions"
            fix = "fit again in the new frame, or with a task kernel of one length scale and one variance"
            raise InputError.of(f"{what}: the model cannot be moved to another frame", fix=fix)


WELL_KNOWN_M = 1e-4  # smaller deviations are never named, whatever the noise
HARDLY = 10.0  # a direction is hardly determined if its deviation is so many times that of a predicted row
SPREAD, TURN = "spread the poses over the workspace", "turn the tool about several axes between the poses"


def undetermined(
    covariance: Tensor, markers: Tensor, arm: float, usual: float, tips: Sequence[str], *, rigid: bool
) -> tuple[str, ...]:
    """Sentences about the directions of frame and markers whose deviations are large.

    Args:
        covariance: (6 + 3 P, 6 + 3 P) of shift and turn of the measuring frame about the middle of the rows, then of
            the markers in the tip's frame, m and rad.
        markers: (P, 3) in the tip's frame, m.
        arm: distance from the middle of the rows at which a turn of the frame matters, m.
        usual: deviation of a coordinate of a predicted row, m. tips: names of those of the markers.
        rigid: whether the markers are the points of measured frames, three of each.
    """
    limit = max(HARDLY * usual, WELL_KNOWN_M)
    together = covariance[:6, 6:]
    frame = covariance[:6, :6] - together @ torch.linalg.pinv(covariance[6:, 6:], hermitian=True) @ together.mT
    parts = [
        ("the place of the measuring frame", frame[:3, :3], limit, "mm", SPREAD),
        ("the turn of the measuring frame", frame[3:, 3:], limit / max(arm, usual), "degrees", SPREAD),
    ]
    each = POINTS if rigid else 1
    blocks = own_blocks(covariance[None, 6:, 6:], len(markers) // each)[0]
    for k, (block, points, tip) in enumerate(zip(blocks, markers.split(each), tips[::each], strict=True)):
        if not rigid:
            name = f"marker {k}" if len(markers) > 1 else "the marker"
            parts.append((f"the place of {name} on '{tip}'", block, limit, "mm", TURN))
            continue
        arms = points - points.mean(0)
        motion = torch.linalg.pinv(frame_slopes(points[None], points.mean(0))[0])  # (6, 9)
        moved, lever = motion @ block @ motion.mT, float(arms.square().sum(1).mean().sqrt())
        parts.append((f"the place of the measured frame on '{tip}'", moved[:3, :3], limit, "mm", TURN))
        parts.append((f"the turn of the measured frame on '{tip}'", moved[3:, 3:], limit / lever, "degrees", TURN))
    return tuple(text for part in parts if (text := _sentence(*part)))


def _sentence(what: str, covariance: Tensor, limit: float, unit: str, fix: str) -> str:
    """A sentence about the directions with large deviations, the largest first; empty if there are none."""
    values, vectors = torch.linalg.eigh(covariance)
    pairs = zip(values.clamp(min=0).sqrt().flip(0).tolist(), vectors.mT.flip(0), strict=True)
    large = [(s, v * v[v.abs().argmax()].sign()) for s, v in pairs if s > limit]
    sizes = [degrees(s) if unit == "degrees" else 1e3 * s for s, _ in large]
    to = ", ".join(f"{size:.2g}" if size < 99.5 else f"{round(size, -1):.0f}" for size in sizes)
    along = ", ".join("(" + ", ".join(f"{value + 0.0:.2f}" for value in v.tolist()) + ")" for _, v in large)
    along = "" if len(large) == len(covariance) else f" {'about' if unit == 'degrees' else 'along'} {along}"
    return f"{what}{along} is known to {to} {unit} only: {fix}" if large else ""
