"""Serial robots: trees whose joints follow one another from the base to the only tip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.tree import Ends, Tree


class Chain(Tree):
    """A serial robot: ``robot(q)`` is the pose of its tip in its base, (N, 4, 4) [m].

    Args:
        name: the robot's name, used in messages.
        base: name of the frame poses are expressed in.
        tip: name of the frame whose pose is computed.
        joints: the joints from base to tip, fixed ones included.
        drivers: joints off the chain that drive mimic joints of it.
        source: text of the URDF file that describes the robot, see :class:`Tree`.

    Raises:
        RobotError: as :class:`Tree`.
    """

    def __init__(
        self,
        name: str,
        base: str,
        tip: str,
        joints: Sequence[Joint],
        *,
        drivers: Sequence[Joint] = (),
        source: str | None = None,
    ) -> None:
        parents = range(-1, len(joints) - 1)
        super().__init__(name, base, joints, parents, Ends({tip: len(joints) - 1}), drivers=drivers, source=source)

    @property
    def tip_offset(self) -> Tensor:
        """(4, 4) the constant transform after the last moving joint [m]."""
        return self.tip_offsets[0]

    def to_config(self) -> dict[str, Any]:
        """Name, links and joints as JSON values, for :func:`robot_from_config`."""
        joints = [joint.to_config() for joint in self.joints]
        drivers = {"drivers": [joint.to_config() for joint in self.drivers]} if self.drivers else {}
        return {"name": self.name, "base": self.base, "tip": self.tips[0], "joints": joints} | drivers


def robot_from_config(config: Mapping[str, Any], source: str | None = None) -> Tree:
    """The inverse of :meth:`Tree.to_config`; ``source`` as in :class:`Tree`.

    Raises:
        KeyError, TypeError, ValueError: an argument is missing, or of another kind.
        RobotError: joints that make no robot.
    """
    joints = [Joint.from_config(joint) for joint in config["joints"]]
    drivers = [Joint.from_config(joint) for joint in config.get("drivers", ())]
    given: dict[str, Any] = {"drivers": drivers, "source": source}
    if "tip" in config:
        return Chain(config["name"], config["base"], config["tip"], joints, **given)
    ends = Ends(dict(config["tips"]), dict(config["loads"]), config["ground"])
    return Tree(config["name"], config["base"], joints, config["parents"], ends, **given)
