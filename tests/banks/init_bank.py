"""Tables of a simulated arm for `init`; measured with a tracker, in sockets, and by a wire from two anchors."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from numbers_bank import normal
from simulated_sockets import rest_in_sockets
from torch import Tensor

from diffeo_calib.robots.simulated_arm import SimulatedArm

ARM, ROWS = SimulatedArm(seed=3), 40
NAMES, XYZ = list(ARM.nominal.joint_names), ["x", "y", "z"]
SERIES = [f"j{k}" for k in range(1, 7)]
Proposed = Callable[..., tuple[dict[str, Any], str]]
noise = partial(normal, seed=1)


def rows() -> tuple[Tensor, Tensor]:
    """Joint values, deg, and places, mm."""
    q, points = ARM.measure(ROWS, seed=0)
    return q.rad2deg(), 1e3 * points[:, 0]


def reasons(text: str) -> dict[str, str]:
    """What stands beside each entry."""
    lines = [line.partition("  # ") for line in text.splitlines() if not line.startswith("#")]
    return {line.partition(" = ")[0]: why for line, _, why in lines}


ANCHORS = torch.tensor([[1.2, 0.0, 0.2], [-0.6, 1.0, 0.3]], dtype=torch.float64)
"""(2, 3) Fixed points of the wire in the robot's base frame, m."""


def write_socket_table(
    path: Path, arm: SimulatedArm, sockets: str, seed: int, *, places: int = 3, rows: int = 6
) -> None:
    """Places x 2 sockets x rows, the joints in degrees. ``sockets``: their names, a letter each."""
    resting = rest_in_sockets(arm, seed=seed, places=places, rows=rows)
    lines = [",".join(["place", "socket", *arm.nominal.joint_names])]
    for q, name in zip(resting.q.rad2deg().tolist(), resting.names, strict=True):
        place, socket = name.split("/")
        lines.append(",".join([f"spot {place}", sockets[int(socket)], *map(repr, q)]))
    path.write_text("\n".join(lines))


def write_wire_table(path: Path, arm: SimulatedArm, seed: int) -> None:
    """64 rows of a wire pulled from two anchors in turn, without noise, in mm; the joints in degrees."""
    q, which = arm.sample(64, seed), torch.arange(64) % 2
    z = (arm.true_points(q)[:, 0] - arm.truth.base[:3, 3]) @ arm.truth.base[:3, :3]
    wire = 1e3 * (z - ANCHORS[which]).norm(dim=1)
    lines = [",".join([*arm.nominal.joint_names, "wire", "anchor"])]
    for angles, length, anchor in zip(q.rad2deg().tolist(), wire.tolist(), which.tolist(), strict=True):
        lines.append(",".join([*map(repr, angles), repr(length), "AB"[anchor]]))
    path.write_text("\n".join(lines))
