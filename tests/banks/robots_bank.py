"""Chains of every kind in general position: slides, mimic joints, frames with one origin."""

from dataclasses import replace
from math import pi

import pytest
import torch
from torch import Tensor

from diffeo_calib.robots import Chain, Joint, SimulatedArm, from_dh
from diffeo_calib.robots.se3 import rotation, twist_transform


def draw(*shape: int, seed: int = 0, size: float = 1.0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return size * torch.randn(*shape, dtype=torch.float64, device="cpu", generator=generator)


def tool_frame() -> Tensor:
    """A tool 0.25 m from the flange, tilted."""
    frame = torch.eye(4, dtype=torch.float64)
    frame[:3, :3] = rotation(torch.tensor([0.4, -0.9, 0.3], dtype=torch.float64))
    frame[:3, 3] = torch.tensor([0.15, -0.12, 0.16], dtype=torch.float64)
    return frame


def crooked(kinds: list[str], mimic: dict[int, dict[str, float]] | None = None) -> Chain:
    """Joints j0, j1, ... in general position."""
    origins = twist_transform(draw(len(kinds), 6, seed=1, size=0.4))
    joints = [
        Joint(f"j{k}", kind, origin, axis)
        for k, (kind, origin, axis) in enumerate(zip(kinds, origins, draw(len(kinds), 3, seed=2), strict=True))
    ]
    for k, multipliers in (mimic or {}).items():
        joints[k] = replace(joints[k], mimic=multipliers, mimic_offset=0.2)
    return Chain("crooked", "floor", "hand", joints)


def parallelogram() -> Chain:
    return crooked([*["revolute"] * 5, "fixed"], {2: {"j1": -1.0}, 3: {"j1": 0.5, "j4": -2.0}})


CHAINS = {
    "serial": crooked(["revolute"] * 4 + ["fixed"]),
    "slides": crooked(["prismatic", "revolute", "prismatic", "revolute", "fixed", "prismatic"]),
    "gantry": crooked(["prismatic"] * 3),
    "mimic joints": parallelogram(),
    "mimic slides": crooked(["revolute", "prismatic", "revolute", "prismatic"], {1: {"j0": 0.3}, 3: {"j2": -0.2}}),
    "arm": SimulatedArm().nominal,
    "wrist in one point": from_dh(
        [(0.0, pi / 2, 0.3), (0.4, 0.0, 0.0), (0.0, pi / 2, 0.0), (0.0, -pi / 2, 0.4), (0.0, pi / 2, 0.0), (0, 0, 0.1)]
    ),
    "one joint": crooked(["revolute"]),
}
every_chain = pytest.mark.parametrize("chain", CHAINS.values(), ids=CHAINS.keys())
