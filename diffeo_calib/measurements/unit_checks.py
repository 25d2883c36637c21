"""Values that look as if they were in another unit: sentences about them, from the largest absolute values.

Units must always be named. They are never guessed; these checks only warn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from diffeo_calib.common.errors import warn_user

LARGEST_JOINT_ANGLE_RAD = 4 * math.pi
"""Few axes turn further, so larger values are probably degrees."""
LARGEST_POSITION_M = 100.0
"""Few measurement volumes are larger, so larger values are probably millimetres."""
SMALLEST_POSITION_MM = 10.0
"""Few measurement volumes are smaller, so smaller values are probably metres."""
SMALLEST_SLIDE_MM = 2.0
"""Few slides move less, so smaller values are probably metres."""
LARGEST_ROTATION_RAD = 2 * math.pi + 0.01
"""No rotation is written with larger values, apart from rounding."""


def unlikely_joint_units(largest: float, unit: str, *, kinds_known: bool) -> list[str]:
    """Sentences about joint values that reach ``largest`` in ``unit``, "rad" or "deg"."""
    if unit == "rad" and largest > LARGEST_JOINT_ANGLE_RAD:
        text = f"angles reach {largest:g} rad: they look like degrees"
        if kinds_known:
            return [f"{text}; pass angle='deg' if they are."]
        slide = "or like millimetres of a prismatic joint; pass the robot, which knows its prismatic joints"
        return [f"{text}, {slide}, or angle='deg' if they are degrees."]
    if unit == "deg" and 0 < largest <= 2 * math.pi:
        return [f"angles reach only {largest:g} deg: they look like radians; pass angle='rad' if they are."]
    return []


def unlikely_slide_units(largest: float, unit: str) -> list[str]:
    """Sentences about prismatic joints that reach ``largest`` in ``unit``, "m" or "mm"."""
    if unit == "m" and largest > LARGEST_POSITION_M:
        text = f"prismatic joints reach {largest:g} m: they look like millimetres"
        return [f"{text}; pass joint_length='mm' if they are."]
    if unit == "mm" and 0 < largest < SMALLEST_SLIDE_MM:
        text = f"prismatic joints reach only {largest:g} mm: they look like metres"
        return [f"{text}; pass joint_length='m' if they are."]
    return []


def unlikely_position_units(largest: float, unit: str) -> list[str]:
    """Sentences about positions that reach ``largest`` in ``unit``, "m" or "mm"."""
    if unit == "m" and largest > LARGEST_POSITION_M:
        return [f"positions reach {largest:g} m: they look like millimetres; pass length='mm' if they are."]
    if unit == "mm" and 0 < largest < SMALLEST_POSITION_MM:
        return [f"positions reach only {largest:g} mm: they look like metres; pass length='m' if they are."]
    return []


def unlikely_rotation_units(largest: float, unit: str) -> list[str]:
    """Sentences about Euler angles or rotation vectors that reach ``largest`` in ``unit``, "rad" or "deg"."""
    if unit == "rad" and largest > LARGEST_ROTATION_RAD:
        return [f"rotations reach {largest:g} rad: they look like degrees; pass rotation_angle='deg' if they are."]
    if unit == "deg" and 0 < largest <= 2 * math.pi:
        text = f"rotations reach only {largest:g} deg: they look like radians"
        return [f"{text}; pass rotation_angle='rad' if they are."]
    return []


def unlikely_si_joints(q: Tensor, joint_names: Sequence[str] | None) -> list[str]:
    """Sentences about joint values (N, n) that should be in rad and m; the kinds of the joints are not known."""
    largest, joint = (float(value) for value in q.abs().amax(dim=0).max(dim=0))
    if largest <= LARGEST_JOINT_ANGLE_RAD:
        return []
    name = f" ('{joint_names[int(joint)]}')" if joint_names else ""
    text = f"`q`, column {int(joint)}{name} reaches {largest:g}: values look like degrees, or like millimetres of a"
    return [f"{text} prismatic joint; convert them to rad or m if they are."]


def warn_if_suspicious(data: Any) -> None:
    """Warn about exact copies of the rows of measurements, and about joint values that look like degrees."""
    pairs = data.copies()
    if pairs:
        where = f"first row {pairs[0][1]}, of row {pairs[0][0]}"
        text = f"{len(pairs)} of {len(data)} rows repeat an earlier row exactly: {where}"
        warn_user(f"{text}; real repeats differ by noise: remove these rows if they are copies.")
    for text in unlikely_si_joints(data.q, data.joint_names):
        warn_user(text)
