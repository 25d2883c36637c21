"""Chains of every kind in general position: slides, mimic joints, frames with one origin."""

from collections.abc import Mapping
from dataclasses import replace
from math import inf, pi
from pathlib import Path

import pytest
import torch
from numbers_bank import normal as draw
from torch import Tensor

from diffeo_calib.robots import Chain, Joint, SimulatedArm, from_dh
from diffeo_calib.robots.se3 import rotation, twist_transform


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


def limited(*limits: tuple[str, float, float]) -> Chain:
    """Joints j0, j1, ... (kind, lower, upper) about z, 0.3 m from each other."""
    origin = torch.eye(4, dtype=torch.float64)
    origin[0, 3] = 0.3
    joints = [Joint(f"j{k}", kind, origin, lower=low, upper=high) for k, (kind, low, high) in enumerate(limits)]
    return Chain("limited", "base", "tip", joints)


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

FOLDER = Path(__file__).with_name("urdf")
CROOKED = FOLDER / "crooked.urdf"
"""Slides and turns about crooked axes, a fixed joint in the middle, and a side branch that must be ignored."""
LIFT = FOLDER / "lift.urdf"
"""Slides and turns that drive one another."""


# --- one machine with every kind of mimic joint -----------------------------------------------------------------------

# Everything at once: a mimic joint before its driver, a sum, a mimic of a mimic, slides driven by turning joints.
KINDS = {
    "early": "revolute",
    "waist": "continuous",
    "plate": "fixed",
    "rail": "prismatic",
    "sum": "revolute",
    "elbow": "revolute",
    "rack": "prismatic",
    "second": "revolute",
}
MIMIC: dict[str, tuple[Mapping[str, float], float]] = {
    "early": ({"rail": 1.5}, -0.2),
    "sum": ({"waist": -1.0, "elbow": -1.0}, 0.3),
    "rack": ({"elbow": 0.1}, 0.0),
    "second": ({"sum": -0.5, "rack": 2.0, "waist": 0.25}, 0.7),
}
MOVING = [name for name, kind in KINDS.items() if kind != "fixed"]


def crooked_joints(kinds: Mapping[str, str], seed: int = 1) -> list[Joint]:
    """Joints in general position, each about half a metre from the previous one."""
    origins, axes = twist_transform(draw(len(kinds), 6, seed=seed, size=0.4)), draw(len(kinds), 3, seed=seed + 1)
    limits = {"prismatic": (-0.3, 0.5), "revolute": (-2.0, 1.5)}
    return [
        Joint(name, kind, origin, axis, *limits.get(kind, (-inf, inf)))
        for (name, kind), origin, axis in zip(kinds.items(), origins, axes, strict=True)
    ]


def build(joints: list[Joint], mimic: Mapping[str, tuple[Mapping[str, float], float]] | None = None) -> Chain:
    given = mimic or {}
    coupled = [
        replace(j, mimic=given[j.name][0], mimic_offset=given[j.name][1]) if j.name in given else j for j in joints
    ]
    return Chain("machine", "floor", "hand", coupled)


CHAIN = build(crooked_joints(KINDS), MIMIC)


def expand(q: Tensor) -> Tensor:
    """Values of MOVING, written out by hand."""
    waist, rail, elbow = q.unbind(1)
    total = 0.3 - waist - elbow
    rack = 0.1 * elbow
    return torch.stack(
        [1.5 * rail - 0.2, waist, rail, total, elbow, rack, 0.7 - 0.5 * total + 2 * rack + 0.25 * waist], dim=1
    )
