"""Collisions of a robot with itself, by the collision geometry of its URDF, with pinocchio and coal if installed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.planning.candidates import joint_ranges
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, few
from diffeo_calib.robots.tree import Tree

ALWAYS_DRAWS = 200
"""Random configurations in which pairs of bodies that always collide are found: neighbours that overlap by design."""


def collision_free(
    robot: Tree, *, packages: Sequence[str | PathLike[str]] = (), seed: int = 0
) -> Callable[[Tensor], Tensor]:
    """A check for ``dc.candidates(..., keep=...)``: whether no two bodies of the URDF collide.

    Bodies of one link, of links that are joined to each other, and pairs that collide in all of 200 random
    configurations are left out. Joints of the URDF that are not in the chain stay at zero.

    Args:
        robot: a chain that was read from a URDF.
        packages: folders in which ``package://`` names of meshes are looked up.
        seed: of the random configurations.

    Returns:
        a function of configurations (N, n), rad or m, that returns (N,) booleans.

    Raises:
        InputError: pinocchio is not installed, the robot has no URDF or no collision geometry, meshes are missing, or a
            joint of the chain cannot be found.
    """
    try:
        import pinocchio as pin  # noqa: PLC0415  # optional
    except ImportError as error:
        fix = "pip install pin, or pass your own check as `keep`"
        raise InputError.of("collisions need the package pinocchio, which is not installed", fix=fix) from error
    world = _World(pin, robot, [str(path) for path in packages])
    lower, upper = joint_ranges(robot, _unlimited(robot))
    draw = np.random.default_rng(seed).random((ALWAYS_DRAWS, robot.n))
    world.leave_out_constant(lower.numpy() + (upper - lower).numpy() * draw)
    return lambda q: torch.tensor([world.free(row) for row in q.cpu().numpy()], dtype=torch.bool, device=HOST)


def _unlimited(robot: Tree) -> dict[str, tuple[float, float]]:
    """Any range for slides without limits."""
    ends = zip(robot.joint_names, robot.periodic, robot.limits.isfinite().all(1).tolist(), strict=True)
    return {name: (0.0, 1.0) for name, turns, limited in ends if not (turns or limited)}


class _World:
    """The bodies of a URDF and the pairs that may collide."""

    def __init__(self, pin: Any, robot: Tree, packages: list[str]) -> None:
        if robot.source is None:
            fix = "load it with dc.load_urdf, or pass your own check as `keep`"
            what = f"robot '{robot.name}' was not read from a URDF, which holds collision geometry"
            raise InputError.of(what, fix=fix)
        self.pin = pin
        source = robot.source.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
        try:
            self.model = pin.buildModelFromXML(source)
            kind = pin.GeometryType.COLLISION
            self.bodies = pin.buildGeomFromUrdfString(self.model, source, kind, package_dirs=packages)
        except (ValueError, RuntimeError) as error:
            what = f"the collision geometry of robot '{robot.name}' cannot be read ({' '.join(str(error).split())})"
            raise InputError.of(what, fix="name the folders of its meshes (`packages`)") from error
        if not self.bodies.ngeoms:
            raise InputError.of(f"the URDF of robot '{robot.name}' has no collision geometry", fix="leave it out")
        self.data = self.model.createData()
        missing = [name for name in robot.moving_names if not self.model.existJointName(name)]
        if missing:
            raise InputError.of(f"pinocchio finds no joint {few(missing)} in the URDF", fix="pass your own check")
        self.joints = [self.model.joints[self.model.getJointId(name)] for name in robot.moving_names]
        self.robot = robot
        self._pairs([pair for pair in self._all_pairs() if not self._joined(*pair)])

    def free(self, q: np.ndarray) -> bool:
        """Whether no pair collides: q (n,)."""
        return not self.pin.computeCollisions(self.model, self.data, self.bodies, self.checked, self._full(q), True)

    def leave_out_constant(self, q: np.ndarray) -> None:
        """Leave out pairs that collide in all of these configurations (N, n)."""
        always = np.ones(len(self.bodies.collisionPairs), dtype=bool)
        for row in q:
            self.pin.computeCollisions(self.model, self.data, self.bodies, self.checked, self._full(row), False)
            always &= np.array([result.isCollision() for result in self.checked.collisionResults], dtype=bool)
        pairs = [(pair.first, pair.second) for pair in self.bodies.collisionPairs]
        self._pairs([pair for pair, constant in zip(pairs, always, strict=True) if not constant])

    def _pairs(self, pairs: list[tuple[int, int]]) -> None:
        self.bodies.removeAllCollisionPairs()
        for first, second in pairs:
            self.bodies.addCollisionPair(self.pin.CollisionPair(first, second))
        self.checked = self.pin.GeometryData(self.bodies)

    def _all_pairs(self) -> list[tuple[int, int]]:
        count = self.bodies.ngeoms
        return [(first, second) for first in range(count) for second in range(first + 1, count)]

    def _joined(self, first: int, second: int) -> bool:
        """Whether two bodies move together or are neighbours."""
        a, b = (self.bodies.geometryObjects[k].parentJoint for k in (first, second))
        return a == b or self.model.parents[a] == b or self.model.parents[b] == a

    def _full(self, q: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration; continuous joints are pairs (cos, sin) there."""
        full = self.pin.neutral(self.model)
        values = self.robot.moving_values(torch.from_numpy(np.atleast_2d(q)))[0].tolist()
        for joint, value in zip(self.joints, values, strict=True):
            full[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if joint.nq == 2 else value
        return full
