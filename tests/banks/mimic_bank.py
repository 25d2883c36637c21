"""One machine with every kind of mimic joint, and the same machine with all its joints active."""

from collections.abc import Mapping
from dataclasses import replace
from math import inf

import torch
from robots_bank import draw
from torch import Tensor

from diffeo_calib.robots import Chain, Geometry, Joint
from diffeo_calib.robots.se3 import twist_transform

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


def errors_of(chain: Chain, markers: int = 2, size: float = 0.3) -> Geometry:
    """A geometry in general position."""
    twists = twist_transform(draw(chain.moving + 1, 6, seed=5, size=size))
    return replace(
        Geometry.nominal(chain, markers), base=twists[0], joint_errors=twists[1:], tool=draw(markers, 3, seed=6)
    )
