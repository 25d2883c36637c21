"""The error field of a machine with commanded places: corrections of its commands on a grid."""

from __future__ import annotations

from math import prod

import torch

from diffeo_calib.common.errors import InputError
from diffeo_calib.interop.files import LENGTHS, table_text
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.compensation.compensate import compensate
from diffeo_calib.robots.cartesian import SLIDES, is_cartesian

MOST_POINTS = 100_000
DIGITS = 7


def field_text(model: CalibratedKinematics, grid: str, length: str) -> str:
    """A table of places within those of the fit, what to add to commands there, and its standard deviations, as CSV.

    Orientations are in the middle of those of the fit. Deviations are those of the first marker, or point of a pose,
    along the axes of the machine.

    Args:
        model: of a machine with commanded places or poses, see :func:`diffeo_calib.cartesian`.
        grid: numbers of points along each axis, such as "5x5x3". length: unit in the file.

    Raises InputError: a model of joint values, another number of axes, or more than 100,000 points.
    """
    robot, counts = model.robot, [int(word) if word.isdigit() else 0 for word in grid.lower().split("x")]
    axes = min(robot.n, len(SLIDES))
    if not is_cartesian(robot):
        fix = "calibrate with --robot-pose, or correct a program with `correct`"
        raise InputError.of("an error field", expected="a machine with commanded places", got=robot.name, fix=fix)
    if len(counts) != axes or min(counts) < 2 or prod(counts) > MOST_POINTS:
        expected = f"{axes} numbers of 2 or more, such as {'x'.join('5' * axes)}, at most {MOST_POINTS} points"
        raise InputError.of(f"--grid {grid}", expected=expected)
    fitted = model.configurations
    ends = zip(fitted.amin(0)[:axes].tolist(), fitted.amax(0)[:axes].tolist(), counts, strict=True)
    lines = [torch.linspace(*each, dtype=fitted.dtype, device=fitted.device) for each in ends]
    places = torch.cartesian_prod(*lines).view(-1, axes)
    q = torch.cat([places, places.new_zeros(len(places), robot.n - axes)], 1)
    targets = robot(q) @ model.tool
    found = compensate(model, targets if robot.n > axes else targets[:, :3, 3], q)
    base = model.geometry.base[:3, :3]
    known = base.mT @ model.predict(q, noise=False)[1][:, 0] @ base
    deviations = known.diagonal(dim1=1, dim2=2)[:, :axes].sqrt()
    cells = LENGTHS[length] * torch.cat([places, found.correction[:, :axes], deviations], 1)
    header = [f"{word}{axis} [{length}]" for word in ("", "add_", "std_") for axis in "xyz"[:axes]]
    return table_text(header, cells.round(decimals=DIGITS).tolist())
