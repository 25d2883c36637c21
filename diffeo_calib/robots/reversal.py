"""The same joints seen from another link: those on the way to it run backwards.

A joint O J(q) from its parent to its link leads back as J(q)^-1 O^-1, a motion about the opposite axis and a constant
transform. Values, limits and mimic joints stay as they are. The gravity sag has its unknown masses at the joints'
frames: those of turning joints are at the same places from either side, that of a slide is at its other end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.se3 import transforms

BASE = -1
"""Stands for the base where the number of a joint is asked for."""


def seen_from(
    link: int, joints: Sequence[Joint], parents: Sequence[int]
) -> tuple[list[Joint], list[int], dict[int, int]]:
    """Joints and parents with another link as base, see :class:`~diffeo_calib.robots.tree.Tree`.

    Args:
        link: the new base, by the number of the joint before it.
        joints: K joints. parents: numbers of the joints before them, -1 for the base.

    Returns:
        the joints, first those from the new base to the old one, their parents, and for every link of the old numbers
        (-1 for the old base) the number of the last joint before it now, -1 for the new base.
    """
    found: list[Joint] = []
    before: list[int] = []
    last = {link: BASE}

    def add(joint: Joint, parent: int) -> int:
        found.append(joint)
        before.append(parent)
        return len(found) - 1

    way = []
    while link != BASE:
        way.append(link)
        end = last[link]
        for joint in _backwards(joints[link]):
            end = add(joint, end)
        link = parents[link]
        last[link] = end
    for number, joint in enumerate(joints):
        if number not in way:
            last[number] = add(joint, last[parents[number]])
    return found, before, last


def _backwards(joint: Joint) -> list[Joint]:
    """The joint from its link to its parent: its motion, then a fixed transform."""
    turned = joint.origin[:3, :3].T
    back = transforms(turned, -turned @ joint.origin[:3, 3])
    if joint.kind == "fixed":
        return [replace(joint, origin=back)]
    eye = torch.eye(4, dtype=torch.float64, device="cpu")
    return [replace(joint, origin=eye, axis=-joint.axis), Joint(f"{joint.name} (origin)", "fixed", back)]
