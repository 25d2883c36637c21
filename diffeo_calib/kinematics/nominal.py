"""The nominal kinematics of a robot as a map with parameters: errors of its geometry, gears and axes, gravity sag."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.checks import wrapped
from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.gravity import GravitySag
from diffeo_calib.robots.payload import NO_PAYLOAD, Payload
from diffeo_calib.robots.se3 import skew
from diffeo_calib.runtime.build import axis_waves, gear_waves
from diffeo_calib.runtime.chain import Waves, wave_angles, wave_slopes, wave_sums

TURNS_FROM = 3  # place of the first rotation in a twist; the translations are before it


class PositionErrors(NamedTuple):
    """Errors of joints that depend on their own position.

    Waves of reduction gears, at multiples of their ratio, add C cos(w x) + S sin(w x) to the value x of an active
    joint, taken on a line and not on a circle: w need not be an integer. Straightness, scale, roll, pitch and yaw of a
    guide, or the wobble of a bearing, shift and turn the frame before a moving joint, in addition to its constant error
    twist:

        tau(x) = sum_k c_k cos(k pi (x - low) / (high - low)),    k = 1 ... K.

    They are smooth functions of a Gaussian process on [low, high] (A. Solin, S. Sarkka, "Hilbert space methods for
    reduced-rank Gaussian process regression", 2020), constant beyond.
    """

    waves: tuple[tuple[int, float], ...] = ()  # active joint, of which there may be several; w, rad per unit of it
    axes: tuple[tuple[int, float, float, int], ...] = ()  # moving joint; low, high, rad or m; count K


NO_ERRORS = PositionErrors()


class GeometryMap(NominalMap):
    """Marker positions of a robot with geometric errors and elastic deflections: m = 3 P.

    theta holds the error parameters of the geometry, then the coefficients of the elasticity, whose error twists
    depend on the configuration, then those of the gears' waves, which turn the joints before all else, and of the axes.

    Args:
        geometry: the geometry at theta = 0.
        elastic: whether theta includes coefficients of elasticity.
        own: errors of joints that depend on their own position.
        payload: known masses that the robot carries, for an elastic one.
        rigid: whether markers are points of frames, three each, which move as a whole: what bends them has no effect.
    """

    def __init__(
        self,
        geometry: Geometry,
        *,
        elastic: bool = False,
        own: PositionErrors = NO_ERRORS,
        payload: Payload = NO_PAYLOAD,
        rigid: bool = False,
    ) -> None:
        n, n_all = geometry.chain.n, geometry.chain.moving
        self.geometry = geometry
        self.elasticity = GravitySag(geometry.chain, payload) if elastic else None
        self.own, self.rigid, self.load = own, rigid, payload
        tables = {"waves": gear_waves(own.waves, n), "axes": axis_waves(own.axes, n_all)}
        self._tables = {name: Waves(*map(torch.from_numpy, table)) for name, table in tables.items()}
        sag, crooked = self.elasticity.size if self.elasticity else 0, sum(6 * count for *_, count in own.axes)
        sizes = sag, 2 * len(own.waves), crooked  # C and S of each wave in turn; of axes c_1 of six components first
        ends = [geometry.size + sum(sizes[:k]) for k in range(len(sizes) + 1)]
        self.parts: dict[str, slice] = dict(zip(("sag", "waves", "axes"), map(slice, ends, ends[1:]), strict=True))
        self.sag, self.parameters = self.parts["sag"], ends[-1]
        entries, parts = range(geometry.size), geometry.slices
        self.places = (*entries[parts["base"]], *entries[parts["tool"]])
        base, joints = entries[parts["base"]], entries[parts["joints"]]
        self.turns = tuple(k for part in (base, joints) for place, k in enumerate(part) if place % 6 >= TURNS_FROM)

    def split(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Split theta into parameters of the geometry and coefficients of the elasticity (empty without elasticity)."""
        return theta[: self.geometry.size], theta[self.sag]

    def folded(self, theta: Tensor) -> Tensor:
        """The theta of a robot for which the payload is a part of its own weight, see :meth:`GravitySag.folded`."""
        if self.elasticity is None:
            return theta
        return torch.cat([theta[: self.sag.start], self.elasticity.folded(theta[self.sag]), theta[self.sag.stop :]])

    def with_geometry(self, geometry: Geometry) -> GeometryMap:
        """Return the parameters around another geometry of the same chain."""
        return self.changed(geometry=geometry)

    def with_payload(self, load: Payload) -> GeometryMap:
        """Return the map with other masses of its payload."""
        return self if load is self.load else self.changed(payload=load)

    def changed(self, **changes: Any) -> GeometryMap:
        """Return the map with other arguments."""
        arguments = {"geometry": self.geometry, "own": self.own, "payload": self.load, "rigid": self.rigid}
        return GeometryMap(elastic=self.elasticity is not None, **arguments | changes)

    def around(self, nominal: GeometryMap) -> GeometryMap:
        """Another nominal map under the payloads of the rows of this one."""
        return nominal.with_payload(self.load)

    def rows(self, index: Tensor | slice) -> GeometryMap:
        """The map at some of the rows whose payloads it knows."""
        return self.with_payload(self.load.rows(index))

    @property
    def typical(self) -> GeometryMap:
        """The map under the median payload of all rows; the map itself where these carry none."""
        return self.with_payload(self.load.typical)

    def under(self, masses: Tensor | None) -> GeometryMap:
        """The map under the masses () or (N,) of new rows; MeasurementError for payloads on one side only."""
        return self.with_payload(self.load.under(masses))

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        """Marker positions in m: (N, 3 P)."""
        x = self.turned(x, theta)
        return self.geometry.points(x, self._errors(x, theta)).flatten(1)

    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        """Dk0 in m/rad or m/m: (N, 3 P, n)."""
        slopes = self._smooth_jacobian(self.turned(x, theta), theta)
        if not self.own.waves:
            return slopes
        return slopes * (1.0 + wave_slopes(self._errors_of("waves", x, theta), x, torch))[:, None]

    def turned(self, x: Tensor, theta: Tensor) -> Tensor:
        """The joint values with the waves of their gears."""
        return x + wave_sums(self._errors_of("waves", x, theta), x, torch) if self.own.waves else x

    def _smooth_jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        """Derivatives by joint values that include their waves: (N, 3 P, n)."""
        errors, chain = self._errors(x, theta), self.geometry.chain
        slopes = self.geometry.jacobian(x, errors).flatten(1, 2)
        if errors.ndim == 1:
            return slopes
        by_twist = self._by_twist(self.geometry.sensitivities(x, errors))
        if self.elasticity is not None:
            turning = self.elasticity.twist_slopes(x, self.split(theta)[1])  # (N, joints, 6, n)
            slopes = slopes + torch.einsum("nmjc,njck->nmk", by_twist, turning)
        if self.own.axes:
            turning = wave_slopes(self._errors_of("axes", x, theta), chain.moving_values(x), torch).unflatten(
                1, (-1, 6)
            )
            slopes = slopes + chain.by_active((by_twist * turning[:, None]).sum(3))
        return slopes

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        """d k0 / d theta in m/m or m/rad: (N, 3 P, K)."""
        turned = self.turned(x, theta)
        by_error = self.geometry.sensitivities(turned, self._errors(turned, theta))
        parts, by_twist = [by_error.flatten(1, 2)], self._by_twist(by_error)
        if self.rigid:
            tool, moves = self.geometry.slices["tool"], rigid_motions(self.geometry.tool.flatten())
            kept = torch.block_diag(*(moves @ moves.mT)).to(x.device)  # (3 P, 3 P) what moves every frame as a whole
            parts = [parts[0][..., : tool.start], parts[0][..., tool] @ kept]
        if self.elasticity is not None:
            parts.append(self.elasticity.sensitivities(turned, by_twist))
        if self.own.waves:
            waves = self._errors_of("waves", x)
            slopes = self._smooth_jacobian(turned, theta)[..., waves.joints]
            parts.append(slopes * wave_angles(waves, x, torch).cos()[:, None])
        if self.own.axes:
            axes = self._errors_of("axes", x)
            functions = wave_angles(axes, self.geometry.chain.moving_values(turned), torch).cos()
            parts.append((by_twist[:, :, axes.joints] * functions[:, None, :, None]).flatten(2))
        return torch.cat(parts, dim=2)

    def along_axis(self, x: Tensor, joint: int) -> Tensor:
        """By theta, what errors of its axis add to the value of an active joint that moves alone, rad or m: (N, K)."""
        chain, slopes = self.geometry.chain, x.new_zeros(len(x), self.parameters)
        moving = chain.moving_names.index(chain.joint_names[joint])
        if self.own.axes and int(chain.coupling[:, joint].count_nonzero()) == 1:
            axes, turns = self._errors_of("axes", x), 3 * int(chain.revolute[moving])
            functions = wave_angles(axes, chain.moving_values(x), torch).cos() * (axes.joints == moving)  # (N, K')
            along = torch.nn.functional.pad(chain.axes[moving], (turns, 3 - turns)).to(x)
            slopes[:, self.parts["axes"]] = (functions[..., None] * along).flatten(1)
        return slopes

    def _errors(self, x: Tensor, theta: Tensor) -> Tensor:
        """Error parameters of the geometry: (K,), or (N, K) where the robot deflects or an axis is crooked."""
        (errors, coefficients), chain = self.split(theta), self.geometry.chain
        live = wrapped(theta) or theta.requires_grad  # what vanishes, in value and derivatives, need not be computed
        twists: list[Tensor] = []  # torch.compile does not follow list[Tensor]()
        if self.elasticity is not None and (live or bool(coefficients.any())):
            twists.append(self.elasticity.twists(x, coefficients).flatten(1))
        if self.own.axes and (live or bool(theta[self.parts["axes"]].any())):
            twists.append(wave_sums(self._errors_of("axes", x, theta), chain.moving_values(x), torch))
        if not twists:
            return errors
        joints, same = self.geometry.slices["joints"], errors.expand(x.shape[0], -1)
        return torch.cat([same[:, : joints.start], errors[joints] + sum(twists), same[:, joints.stop :]], dim=1)

    def _errors_of(self, name: str, x: Tensor, theta: Tensor | None = None) -> Waves:
        """The errors of gears or axes, on the device of joint values; with units of their joints without theta."""
        units = Waves(*(part.to(x.device) for part in self._tables[name]))
        return units if theta is None else units.times(theta[self.parts[name]])

    def _by_twist(self, by_error: Tensor) -> Tensor:
        """The columns of the joints' error twists: (N, P, 3, K) -> (N, 3 P, joints, 6)."""
        return by_error.flatten(1, 2)[..., self.geometry.slices["joints"]].unflatten(-1, (-1, 6))


def rigid_motions(points: Tensor) -> Tensor:
    """Orthonormal columns (..., B, 9, 6), all motions of every three of points (..., 9 B) as a rigid body."""
    arms = points.unflatten(-1, (-1, 3, 3))
    arms = arms - arms.mean(-2, keepdim=True)
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(*arms.shape, 3)
    return torch.linalg.qr(torch.cat([eye, -skew(arms)], -1).flatten(-3, -2)).Q


class FlangePoints(NominalMap):
    """k0 of other points on the flange, with the parameters theta of the map that was fitted: m = 3 P'.

    The fitted parameters keep their meaning; those that shift the measured markers have no effect here. Only if the
    points are these markers after a known motion (``same``), what is not known about the markers' places counts.

    Args:
        fitted: nominal map of the measured markers.
        points: (P', 3) points in their tip's frame, m.
        same: whether the points are the measured markers, one for one.
        on: names of their tips, P' of them; as many points as measured markers are on the same tips by default.
    """

    def __init__(self, fitted: GeometryMap, points: Tensor, *, same: bool = False, on: tuple[str, ...] = ()) -> None:
        self.fitted, self.points, self.same = fitted, points, same
        self.map = fitted.with_geometry(fitted.geometry.with_tool(points, on))
        self.parameters = fitted.parameters

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        """Positions in m: (N, 3 P')."""
        return self.map(x, self._own(theta))

    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        """In m/rad or m/m: (N, 3 P', n)."""
        return self.map.jacobian(x, self._own(theta))

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        """By the fitted parameters, m/m or m/rad: (N, 3 P', K)."""
        of_points, markers = self.map.geometry.slices["tool"], self.fitted.geometry.slices["tool"]
        slopes = self.map.sensitivities(x, self._own(theta))
        if self.same:
            return slopes
        unmoved = slopes.new_zeros(*slopes.shape[:2], markers.stop - markers.start)
        return torch.cat([slopes[..., : of_points.start], unmoved, slopes[..., of_points.stop :]], dim=-1)

    def rows(self, index: Tensor | slice) -> FlangePoints:
        """The map at some of the rows whose payloads it knows."""
        some = self.fitted.rows(index)
        geometry = self.map.geometry
        return self if some is self.fitted else FlangePoints(some, self.points, same=self.same, on=geometry.on)

    def shifts(self, x: Tensor, theta: Tensor) -> Tensor:
        """By shifts of the points in the tip's frame, m/m: (N, 3 P', 3 P')."""
        return self.map.sensitivities(x, self._own(theta))[..., self.map.geometry.slices["tool"]]

    def _own(self, theta: Tensor) -> Tensor:
        """theta of the other points: theirs are not shifted."""
        markers = self.fitted.geometry.slices["tool"]
        return torch.cat([theta[: markers.start], theta.new_zeros(self.points.numel()), theta[markers.stop :]])


class SessionMarkers(NominalMap):
    """k0 at N given rows; the parameters theta are those of all sessions.

    Args:
        nominal: k0 of the newest session; with payloads, under those of the rows.
        session: (N,) number of each row's session, the oldest is 0.
        tools: (sessions, P, 3) markers at theta = 0 in the tip's frame, m.
    """

    def __init__(self, nominal: GeometryMap, session: Tensor, tools: Tensor) -> None:
        self.nominal, self.session, self.tools = nominal, session, tools
        self.parameters, self.turns, self.places = nominal.parameters, nominal.turns, nominal.places
        self.maps = [nominal.with_geometry(nominal.geometry.with_tool(tool)) for tool in tools]

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        """Marker positions in m: (N, 3 P)."""
        return self._by_session(lambda nominal, rows: nominal(x[rows], theta))

    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        """Dk0 in m/rad or m/m: (N, 3 P, n)."""
        return self._by_session(lambda nominal, rows: nominal.jacobian(x[rows], theta))

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        """d k0 / d theta in m/m or m/rad: (N, 3 P, K)."""
        return self._by_session(lambda nominal, rows: nominal.sensitivities(x[rows], theta))

    @property
    def load(self) -> Payload:
        """The payloads of the rows."""
        return self.nominal.load

    def around(self, nominal: GeometryMap) -> SessionMarkers:
        """Return the sessions with the base of another nominal map, and the payloads of their rows."""
        return SessionMarkers(nominal.with_payload(self.load), self.session, self.tools)

    def _by_session(self, of: Callable[[GeometryMap, Tensor], Tensor]) -> Tensor:
        rows = [(self.session.cpu() == number).nonzero()[:, 0] for number in range(len(self.maps))]
        parts = [of(nominal.rows(index), index) for nominal, index in zip(self.maps, rows, strict=True) if len(index)]
        together = torch.cat(parts)
        return together[torch.cat(rows).argsort().to(together.device)]
