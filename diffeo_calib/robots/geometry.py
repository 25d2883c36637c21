"""Geometric errors of a robot, and the exact sensitivities of its points to them.

Marker k sits on the tip ``on[k]`` and is seen by the measuring device at

    y_k(q; theta) = B T(theta_b) prod_l [ O_l E_l T(theta_l) J_l(q_l) ] O_tip (c_k + theta_ck),
    T(t, w) = [[exp([w]x), t], [0, 1]],

the product over the joints l on the path to this tip, with O_l and J_l the robot's constant transforms and motions, B
the base in the measuring frame, E_l a rigid error before every moving joint l = 1 ... n_all (mimic joints included),
and c_k the marker in the tip's frame. Derivatives are those of a serial chain times the ancestor matrix: a joint off
the path moves nothing. The parameters theta are error twists (translation t [m] first, then rotation vector w [rad])
of the base and of every moving joint, and the shifts of the markers. They are redundant on purpose: a prior resolves
the redundancy, so that no parameter has to be left out.

With a frame after its error twist, R' its rotation, o' its origin, d = y - o', and Jr the right Jacobian of SO(3):

    dy/dt = R' exp([w]x)^T,    dy/dw = -[d]x R' Jr(w).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_finite, wrapped
from diffeo_calib.common.device import methods_outside_inference_mode
from diffeo_calib.common.errors import InputError
from diffeo_calib.robots.se3 import right_jacobian, rigid, twist_transform
from diffeo_calib.robots.tree import Tree
from diffeo_calib.runtime.chain import joint_motions, walk


@methods_outside_inference_mode
@dataclass(frozen=True, eq=False)
class Geometry:
    """A robot with its base, error transforms and markers.

    Raises InputError: wrong shapes, values that are not finite, transforms that are not rigid, a tip that is not there.
    """

    chain: Tree  # the nominal robot
    base: Tensor  # (4, 4) the robot's base in the measuring frame [m]
    joint_errors: Tensor  # (n_all, 4, 4) rigid transforms E_l [m], one for each of ``chain.moving_names``
    tool: Tensor  # (P, 3) markers in the frames of their tips [m]
    # P names of these tips, or one for all markers; the first of ``chain.tips`` for all by default
    on: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        on = tuple(self.on) or (self.chain.tips[0],)
        object.__setattr__(self, "on", on[:1] * len(self.tool) if len(set(on)) == 1 else on)
        if any(isinstance(value, Tensor) and wrapped(value) for value in (self.base, self.joint_errors, self.tool)):
            return  # inside torch.func: no branching on values
        names = self.chain.moving_names
        fix = "pass one transform per joint of `chain.moving_names`"
        errors = as_tensor(self.joint_errors, "joint_errors", (len(names), 4, 4), fix=fix)
        checked = [rigid(error, f"joint_errors of '{name}'") for error, name in zip(errors, names, strict=True)]
        object.__setattr__(self, "base", rigid(self.base, "base"))
        object.__setattr__(self, "joint_errors", torch.stack(checked))
        object.__setattr__(self, "tool", as_tensor(self.tool, "tool", ("P", 3)))
        if len(self.on) != len(self.tool) or not set(self.on) <= set(self.chain.tips):
            expected = f"one of {', '.join(self.chain.tips)} for each of {len(self.tool)} markers"
            raise InputError.of("`on`", expected=expected, got=", ".join(map(str, self.on)))

    @classmethod
    def nominal(cls, chain: Tree, markers: int = 1, on: tuple[str, ...] = ()) -> Geometry:
        """Geometry without errors: base at the measuring frame's origin, all markers at their tips' origins."""
        eye = torch.eye(4, dtype=torch.float64, device="cpu")
        tool = torch.zeros(markers, 3, dtype=torch.float64, device="cpu")
        return cls(chain, eye, eye.repeat(chain.moving, 1, 1), tool, on)

    @property
    def markers(self) -> int:
        """Number of markers P."""
        return self.tool.shape[0]

    @property
    def size(self) -> int:
        """Number of parameters K = 6 + 6 n_all + 3 P."""
        return 6 + 6 * self.chain.moving + 3 * self.markers

    @property
    def slices(self) -> dict[str, slice]:
        """Where ``"base"`` (6), ``"joints"`` (6 n_all) and ``"tool"`` (3 P) are in theta."""
        tool = 6 + 6 * self.chain.moving
        return {"base": slice(0, 6), "joints": slice(6, tool), "tool": slice(tool, self.size)}

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the K parameters, such as ``"elbow_joint rz [rad]"`` or ``"marker 0 x [m]"``."""
        twist = ("tx [m]", "ty [m]", "tz [m]", "rx [rad]", "ry [rad]", "rz [rad]")
        frames = [f"{name} {part}" for name in ("base", *self.chain.moving_names) for part in twist]
        return (*frames, *(f"marker {k} {axis} [m]" for k in range(self.markers) for axis in "xyz"))

    @cached_property
    def tip_places(self) -> Tensor:
        """(P,) the place of each marker's tip, a row of ``chain.ancestors``."""
        numbers = [self.chain.moving + self.chain.tips.index(tip) for tip in self.on]
        return torch.tensor(numbers, dtype=torch.int64, device="cpu")

    @cached_property
    def moved(self) -> Tensor:
        """(P, n_all) boolean, whether joint l moves marker k."""
        return self.chain.ancestors[self.tip_places]

    def poses(self, q: Tensor) -> Tensor:
        """Poses of the tip in the measuring frame, errors included: (N, n) -> (N, 4, 4), or (N, tips, 4, 4) [m]."""
        poses = self._walk(q, None).places[:, self.chain.tip_places]
        return poses if len(self.chain.tips) > 1 else poses[:, 0]

    def marker_poses(self, q: Tensor, theta: Tensor | None = None) -> Tensor:
        """Poses in the measuring frame of the tips that carry the markers, see :meth:`points`: -> (N, P, 4, 4) [m]."""
        return self._walk(q, theta).tips

    def marker_turns(self, q: Tensor) -> Tensor:
        """Orientations of these tips: (N, n) -> (N, P, 3, 3)."""
        return self.marker_poses(q)[..., :3, :3]

    def points(self, q: Tensor, theta: Tensor | None = None) -> Tensor:
        """Markers in the measuring frame: q (N, n), theta (K,) or per row (N, K), None for zero -> (N, P, 3) [m]."""
        return self._walk(q, theta).points

    def jacobian(self, q: Tensor, theta: Tensor | None = None) -> Tensor:
        """Derivatives of the points by the active joints, at fixed theta: (N, P, 3, n) [m/rad or m/m]."""
        at = self._walk(q, theta)
        return self.chain.point_slopes(at.places[:, : self.chain.moving], at.points, self.moved)

    def sensitivities(self, q: Tensor, theta: Tensor | None = None) -> Tensor:
        """Derivatives of the points by the parameters: (N, P, 3, K) [m/m or m/rad], exact at every theta."""
        at = self._walk(q, theta)
        (N, P), L, device = at.points.shape[:2], self.chain.moving + 1, at.points.device
        frames = torch.cat([at.start.expand(N, 4, 4)[:, None], at.places[:, : L - 1]], dim=1)  # base first
        R = frames[..., :3, :3]
        by_shift = (R @ at.twists[..., :3, :3].mT)[:, None].expand(N, P, L, 3, 3)
        arms = at.points[:, :, None] - frames[:, None, :, :3, 3]  # (N, P, L, 3)
        # -[d]x a = a x d, for every column a of R' Jr; they run along dimension 3 here
        columns = (R @ right_jacobian(at.w)).mT[:, None]  # (N, 1, L, 3 columns, 3 coordinates)
        by_turn = torch.linalg.cross(columns, arms[..., None, :]).mT  # (N, P, L, 3, 3)
        moved = torch.cat([self.moved.new_ones(P, 1), self.moved], dim=1).to(device)  # the base moves all markers
        by_twist = torch.cat([by_shift, by_turn], dim=-1) * moved[..., None, None]
        by_twist = by_twist.movedim(2, 3).reshape(N, P, 3, 6 * L)
        shifts = torch.eye(P, dtype=torch.float64, device=device)  # the shift of a marker moves this marker only
        by_tool = (at.tips[:, :, :3, None, :3] * shifts[None, :, None, :, None]).reshape(N, P, 3, 3 * P)
        return torch.cat([by_twist, by_tool], dim=-1)

    def with_tool(self, tool: Tensor, on: tuple[str, ...] = ()) -> Geometry:
        """Return the robot with other markers (P, 3) on these tips; as many markers as before stay on theirs."""
        kept = self.on if len(tool) == self.markers else ()
        return replace(self, tool=tool, on=on or kept)

    def absorb(self, theta: Tensor) -> Geometry:
        """New geometry whose points at theta = 0 are this one's at ``theta`` (K,)."""
        twists, shifts = self._split(self._theta(theta, self.base[:0]))
        base, errors = self.base @ twists[0], self.joint_errors @ twists[1:]
        return replace(self, base=base, joint_errors=errors, tool=self.tool + shifts)

    def _split(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Error transforms (..., n_all + 1, 4, 4), base first, and shifts of the markers (..., P, 3)."""
        tool = self.slices["tool"]
        twists = theta[..., : tool.start].unflatten(-1, (-1, 6))
        return twist_transform(twists), theta[..., tool].unflatten(-1, (-1, 3))

    def _walk(self, q: Tensor, theta: Tensor | None) -> _State:
        chain, q = self.chain, self.chain.joint_values(q)
        device, theta = q.device, self._theta(theta, q)
        twists, shifts = self._split(theta)
        start = self.base.to(device) @ twists[..., 0, :, :]
        count = chain.tip_places.stop
        ends = chain.tip_offsets.to(device)
        offsets = (chain.offsets.to(device) @ self.joint_errors.to(device) @ twists[..., 1:, :, :]).movedim(-3, 0)
        ends = ends[:, None].expand(-1, q.shape[0], 4, 4) if offsets.ndim > 3 else ends
        motions = joint_motions(chain.motion_terms.to(device), chain.moving_values(q), torch)
        places = walk(start, torch.cat([offsets, ends]), motions, chain.before[:count], torch)
        tips, tool = places[:, self.tip_places.to(device)], self.tool.to(device) + shifts
        points = (tips[..., :3, :3] @ tool[..., None]).squeeze(-1) + tips[..., :3, 3]
        w = theta[..., : self.slices["tool"].start].unflatten(-1, (-1, 6))[..., 3:]
        return _State(w, twists, start, places, tips, points)

    def _theta(self, theta: Tensor | None, like: Tensor) -> Tensor:
        if theta is None:
            return torch.zeros(self.size, dtype=torch.float64, device=like.device)
        values = theta if isinstance(theta, Tensor) else as_tensor(theta, "theta", ("K",), also=("N", "K"))
        if values.shape != ((self.size,) if values.ndim == 1 else (like.shape[0], self.size)):
            expected, got = f"({self.size},), or one such row per configuration", str(tuple(values.shape))
            fix = "order them as `geometry.parameter_names`"
            raise InputError.of("`theta` has the wrong shape", expected=expected, got=got, fix=fix)
        check_finite(values, "theta")
        return values.to(dtype=torch.float64, device=like.device)


class _State(NamedTuple):
    """One pass along the robot."""

    w: Tensor  # (n_all + 1, 3) rotation vectors of the errors, (N, n_all + 1, 3) if they differ between rows
    twists: Tensor  # (..., n_all + 1, 4, 4) transforms of the errors
    start: Tensor  # (..., 4, 4) the base
    places: Tensor  # (N, n_all + tips, 4, 4) joints' frames after their error twists, and tips
    tips: Tensor  # (N, P, 4, 4) those of the markers
    points: Tensor  # (N, P, 3) the markers
